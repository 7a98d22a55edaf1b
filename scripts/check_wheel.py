"""Builds the sdist and the wheel, and uses the wheel as a stranger does, who has no repository.

    python scripts/check_wheel.py [--constraint FILE] [--folder DIR] [--release]

Needs the packages build and twine. Files go to dist/. The wheel is installed into an empty environment, and from an
empty folder there the demo, an export, the viewer and `unmix-process inspect` run. With --release it also refuses what
must not be published: an address that is missing, a version without a date in CHANGELOG.md, a tag of another version.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import urllib.request
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MOST_BYTES = 8_000_000
KEPT_OUT = ("tests/", "benchmarks/", "tools/", "scripts/", ".github/", ".ci/")
"""What neither file may hold."""
DEMO_SECONDS = "20"
FILE = "import numpy; numpy.save('cube.npy', numpy.linspace(0, 1, 480, dtype='f4').reshape(8, 6, 10))"
"""Code that writes a small file to inspect."""


def main() -> None:
    """Build, look, install, use."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--constraint", type=Path, default=ROOT / "constraints.txt", help="of versions to install"
    )
    parser.add_argument("--folder", type=Path, help="work here, and keep it; otherwise a temporary folder")
    parser.add_argument("--release", action="store_true", help="refuse what must not be published")
    options = parser.parse_args()
    if options.release:
        require_releasable()
    with tempfile.TemporaryDirectory(prefix="unmix-wheel-", ignore_cleanup_errors=True) as temporary:
        folder = (options.folder or Path(temporary)).resolve()
        wheel = built(ROOT / "dist")
        use(wheel, folder, options.constraint.resolve())
    print("the wheel works without the repository")


def built(dist: Path) -> Path:
    """The wheel, made from the sdist, once both hold what they should and no more."""
    shutil.rmtree(dist, ignore_errors=True)
    run("build", [sys.executable, "-m", "build", "--outdir", str(dist), str(ROOT)])
    files = sorted(dist.iterdir())
    run("twine check", [sys.executable, "-m", "twine", "check", "--strict", *map(str, files)])
    sdist, wheel = next(dist.glob("*.tar.gz")), next(dist.glob("*.whl"))
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        about = next(name for name in names if name.endswith(".dist-info/METADATA"))
        shown = archive.read(about).decode("utf-8")
    with tarfile.open(sdist) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    tracked = run("git ls-files", ["git", "-C", str(ROOT), "ls-files", "unmix_plugin"]).split()
    faults = [f"{path.name} lacks {name}" for path, found in ((wheel, names), (sdist, packed))
              for name in tracked if name not in found]  # fmt: skip
    faults += [f"{wheel.name} holds {name}" for name in names
               if not name.startswith(("unmix_plugin/", wheel.name.partition("-py3")[0]))]  # fmt: skip
    faults += [f"{sdist.name} holds {name}" for name in packed if name.startswith(KEPT_OUT)]
    faults += [f"{path.name} has {path.stat().st_size:,} bytes, more than {MOST_BYTES:,}"
               for path in files if path.stat().st_size > MOST_BYTES]  # fmt: skip
    if has_address():
        faults += [f"{wheel.name}: the link {link} of the README leads nowhere on PyPI"
                   for link in re.findall(r"\]\((?!https?:|#)([^)]+)\)", shown)]  # fmt: skip
    if faults:
        sys.exit("\n".join(faults))
    print(*(f"{path.name}: {path.stat().st_size / 1e6:.2f} MB" for path in files), sep="\n")
    return wheel


def use(wheel: Path, folder: Path, constraint: Path) -> None:
    """Install the wheel into an empty environment, and run what a stranger runs first."""
    place, home, environment = folder / "place", folder / "home", folder / "venv"
    for empty in (place, home):
        empty.mkdir(parents=True)
    venv.create(environment, with_pip=True)
    programs = environment / ("Scripts" if os.name == "nt" else "bin")
    # A home of its own, so that no kernel and no scene is there yet; and nothing that leads back here.
    variables = {
        name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))
    }
    variables |= {"PATH": f"{programs}{os.pathsep}{variables.get('PATH', '')}", "XDG_CACHE_HOME": str(home)}
    variables |= {"WARP_CACHE_PATH": str(home / "kernels")}

    def stranger(what: str, program: str, *words: str) -> str:
        found = shutil.which(program, path=str(programs))
        return run(what, [found or program, *words], place, variables)

    stranger(
        "pip install",
        "python",
        "-m",
        "pip",
        "install",
        "--quiet",
        "--constraint",
        str(constraint),
        str(wheel),
    )
    where = stranger("import", "python", "-c", "import unmix_plugin; print(unmix_plugin.__file__)")
    if not Path(where.strip()).resolve().is_relative_to(environment.resolve()):
        sys.exit(f"unmix_plugin comes from {where}, not from the wheel")
    stranger("demo", "unmix-demo", "--seconds", DEMO_SECONDS)
    pictures = list((place / "outputs").rglob("*.png"))
    stranger("export", "unmix-export", "point-cloud")
    stranger("a small file", "python", "-c", FILE)
    said = stranger("inspect", "unmix-process", "inspect", "cube.npy")
    if not pictures or not list(place.rglob("*.ply")) or "10 bands" not in said:
        sys.exit(f"{len(pictures)} pictures; {said}")
    look(shutil.which("unmix-view", path=str(programs)) or "unmix-view", place, variables)


def look(program: str, place: Path, variables: dict[str, str]) -> None:
    """Start the viewer, get its first page, stop it."""
    started = time.monotonic()
    with subprocess.Popen([program, "--viewer.port", "0"], cwd=place, env=variables, text=True, encoding="utf-8",
                          stdout=subprocess.PIPE) as viewer:  # fmt: skip
        try:
            said = ""
            for line in viewer.stdout or ():
                said += line
                if address := re.match(r"viewer: (http\S+)", line):
                    page = urllib.request.urlopen(address[1], timeout=30).read().decode()
                    if "<title>" not in page:
                        sys.exit(f"the viewer's page is not one: {page[:200]}")
                    break
            else:
                sys.exit(f"the viewer did not start: {said}")
        finally:
            viewer.terminate()
            if viewer.stdout is not None:
                viewer.stdout.read()
    print(f"viewer: {time.monotonic() - started:.1f} s", flush=True)


def run(what: str, command: list[str], place: Path = ROOT, variables: dict[str, str] | None = None) -> str:
    """What a command prints; leaves with all it said where it fails."""
    started = time.monotonic()
    ended = subprocess.run(command, cwd=place, env=variables, capture_output=True, text=True, encoding="utf-8",
                           errors="replace", check=False)  # fmt: skip
    if ended.returncode != 0:
        sys.exit(
            f"{what} failed with exit code {ended.returncode}: {command}\n{ended.stdout}\n{ended.stderr}"
        )
    print(f"{what}: {time.monotonic() - started:.1f} s", flush=True)
    return ended.stdout


def has_address() -> bool:
    """Whether the package states the address of its repository."""
    return re.search(r"^Repository = ", (ROOT / "pyproject.toml").read_text("utf-8"), re.M) is not None


def require_releasable() -> None:
    """Refuse to publish what is not ready."""
    version = re.findall(
        r'^__version__ = "(.*)"$', (ROOT / "unmix_plugin/__init__.py").read_text("utf-8"), re.M
    )[0]
    faults = []
    tag = os.environ.get("GITHUB_REF_NAME", f"v{version}")
    if tag != f"v{version}":
        faults.append(f"the tag is {tag}, the package has version {version}: make both the same")
    if not re.search(
        rf"^## \[?{re.escape(version)}\]? - \d{{4}}-\d\d-\d\d$",
        (ROOT / "CHANGELOG.md").read_text("utf-8"),
        re.M,
    ):
        faults.append(f"CHANGELOG.md has no heading '## [{version}] - YYYY-MM-DD'")
    if not has_address():
        faults.append(
            "pyproject.toml: add Repository to [project.urls]: links and pictures of the README lead there on PyPI"
        )
    if faults:
        sys.exit("\n".join(faults))


if __name__ == "__main__":
    main()
