"""The site: it builds without a warning, its links lead somewhere, and it loads nothing from elsewhere."""

import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from scripts.check_site import faults_of
from scripts.stage_site import COMMANDS, messages_in
from tests.factories.pages import ROOT, text_of

PAGE = "<html><head><script src='{load}'></script></head><body><article><a href='{link}'>x</a></article></body></html>"


def test_every_command_has_a_page():
    section = text_of("pyproject.toml").split("[project.scripts]")[1].split("\n\n")[0]
    assert sorted(COMMANDS) == sorted(re.findall(r"^(unmix-[a-z-]+) =", section, re.MULTILINE))


def test_a_message_is_listed_by_what_it_says_and_what_to_do():
    code = """
        raise ConfigError(f"{path}: --pixel {text} is {number:g} wide; give a_number above 0 | less")
        raise ConfigError("no advice at all in this one")
        raise KeyError("this is no user's error; so it is left out")
    """
    found = list(messages_in(textwrap.dedent(code), {"ConfigError"}))
    assert found == [("--pixel ... is ... wide", r"give a\_number above 0 \| less")]


def words_of(page: Path) -> str:
    return re.sub("<[^>]*>", "", page.read_text())


@pytest.mark.slow
def test_it_builds_and_has_every_command_and_every_public_name(tmp_path):
    pytest.importorskip("furo")
    pytest.importorskip("myst_nb")
    words = [str(ROOT / "scripts/build_site.sh"), str(tmp_path / "html")]
    with_python = {**os.environ, "PYTHON": sys.executable}
    built = subprocess.run(words, env=with_python, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr + built.stdout
    commands = tmp_path / "html/reference/commands"
    assert "--max-seconds FLOAT" in words_of(commands / "unmix-train.html")
    assert "--unseen {drop,keep}" in words_of(commands / "unmix-export.html")
    assert "has no COLMAP model" in words_of(tmp_path / "html/reference/messages.html")
    names = (tmp_path / "html/reference/python-api.html").read_text()
    assert 'id="unmix_plugin.TrainedScene.probe"' in names


@pytest.mark.parametrize(
    ("link", "load", "fault"),
    [
        ("two.html", "a.js", None),
        ("none.html", "a.js", "index.html links to none.html, which is not there"),
        ("two.html#none", "a.js", "index.html links to two.html#none, a heading that is not there"),
        (
            "two.html",
            "https://cdn.example/a.js",
            "index.html loads https://cdn.example/a.js from another server",
        ),
        ("#", "a.js", "two.html is more than two clicks from the front page"),
    ],
)
def test_faults_of_a_site_are_named(tmp_path: Path, link: str, load: str, fault: str | None):
    (tmp_path / "index.html").write_text(PAGE.format(link=link, load=load))
    (tmp_path / "two.html").write_text(PAGE.format(link="index.html", load="a.js"))
    (tmp_path / "a.js").touch()
    assert fault is None or fault in faults_of(tmp_path)
    assert (faults_of(tmp_path) == []) == (fault is None)
