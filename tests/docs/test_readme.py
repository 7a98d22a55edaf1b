"""README.md and docs/reference/commands.md: every command on them runs as it stands, on a tiny scene; links lead
somewhere; the README is short."""

import re
import shlex
from importlib import import_module

import pytest

from tests.factories.commands import SMALL_METHOD, done, run_of
from tests.factories.pages import ROOT, blocks_of, text_of
from tests.test_public_surface import COMMANDS
from unmix_plugin.products.page import page as page_module

README, COMMANDS_PAGE = "README.md", "docs/reference/commands.md"
MOST_WORDS = 900
PAGES = [
    "README.md",
    "CHANGELOG.md",
    *(path.relative_to(ROOT).as_posix() for path in sorted((ROOT / "docs").rglob("*.md"))),
]
ELSEWHERE = ("unmix-view", "unmix-compare", "unmix-asset")
"""Commands that are not run here: one never ends, others need captures whose surfaces are trained well."""
RUN = "outputs/my-scene/unmix-nerf/2026-01-31_120000"
"""The run that README opens from Python."""
SHORTER = {
    "--max-seconds 600": "--max-num-iterations 40",
    "--pixel 200,220": "--pixel 8,8",
    "--poses estimate": "--poses capture/poses-true.json",
}
"""What a command says for what takes long or is of the reader's own."""
SMALLER = {
    "unmix-train unmix-nerf --data": shlex.join(SMALL_METHOD),
    "unmix-train unmix-nerf --load-run": "--max-num-iterations 50",
    "unmix-render --cameras orbit": "--frames 2 --size 16x16",
    "unmix-export mesh": "--resolution 24 --unseen keep",
    "unmix-demo ": "--seconds 1",
    "unmix-demo-scene --raw": "--size 32 --bands 12 --views 8",
    "unmix-demo-scene my": "--size 16 --bands 4 --views 4",
}
"""What makes a command that starts so take a moment."""


def commands():
    """Command lines of the blocks and of the table's examples in order, but for those of `ELSEWHERE`."""
    lines = [
        line for page in (README, COMMANDS_PAGE) for code in blocks_of(page, "") for line in code.splitlines()
    ]
    lines += re.findall(r"^\|.*\| `(unmix-[^`]*)` \|$", text_of(COMMANDS_PAGE), re.MULTILINE)
    return [line for line in lines if line.startswith("unmix-") and line.split()[0] not in ELSEWHERE]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with the files that the examples name, but for those that they write themselves."""
    folder = tmp_path_factory.mktemp("readme")
    (folder / "paint.csv").write_text("wavelength,paint\n300,0.2\n1100,0.6\n")
    (folder / "responses.csv").write_text("wavelength,R,G\n500,0,1\n600,1,0\n700,0,0\n")
    (recipe,) = blocks_of(COMMANDS_PAGE, "yaml")
    (folder / "edits.yml").write_text(recipe)
    return folder


@pytest.mark.slow
@pytest.mark.usefixtures("no_wait_for_the_disk", "coarse_surfaces")
def test_every_command_runs(place, monkeypatch):
    monkeypatch.chdir(place)
    found = page_module.surface_of
    monkeypatch.setattr(page_module, "surface_of", lambda scene, _cells, **shown: found(scene, 24, **shown))
    ran = set()
    for line in commands():
        for long, short in SHORTER.items():
            line = line.replace(long, short)
        extra = " ".join(words for start, words in SMALLER.items() if f"{line} ".startswith(start))
        if line.startswith("unmix-train") and "unmix-train" in ran and "--load-run" not in line:
            extra += " --max-num-iterations 5"
        command, *argv = shlex.split(f"{line.partition('  #')[0]} {extra}")
        module, function = COMMANDS[command]
        ended = done(getattr(import_module(f"unmix_plugin.commands.{module}"), function), *argv)
        if command not in ran and command == "unmix-train":
            run_of(ended).rename(RUN)
        ran.add(command)
    assert ran == set(COMMANDS) - set(ELSEWHERE)


def test_the_readme_is_short_and_says_first_what_its_pictures_show():
    assert len(re.findall(r"\S*\w\S*", text_of(README))) <= MOST_WORDS  # borders of tables are none
    assert "rendered scenes" in text_of(README).partition("\n```")[0]


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_a_page_and_to_a_heading(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", text_of(page)):
        if target.startswith("http"):
            continue
        name, _, anchor = target.partition("#")
        path = (ROOT / page).parent / name if name else ROOT / page
        assert path.exists(), f"{page} links to {target}"
        if anchor:
            headings = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
            anchors = {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}
            assert anchor in anchors, f"{page} links to {target}"


def test_the_index_lists_every_page():
    listed = set(re.findall(r"\]\(((?:[\w-]+/)?[\w-]+\.(?:md|ipynb))", text_of("docs/index.md")))
    docs = ROOT / "docs"
    pages = [path for path in docs.rglob("*") if path.suffix in (".md", ".ipynb")]
    assert listed == {path.relative_to(docs).as_posix() for path in pages} - {"index.md"}
