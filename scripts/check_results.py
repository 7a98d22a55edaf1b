"""Says which results that docs cite can't be trusted any more, and how to measure them again.

    python scripts/check_results.py

Status 1 if a cited result names no revision of the history or a tree that was changed. A result that is older than the
last change of what it measures is named, too. Needs the history of git.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT))

from benchmarks._depends import measured_by  # noqa: E402 - of the repository, which is not installed


def cited_results() -> list[str]:
    """Names of the results to which README, CONTRIBUTING, CHANGELOG and the pages of docs/ link."""
    pages = [
        *(ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "CHANGELOG")),
        *(ROOT / "docs").rglob("*.md"),
    ]
    texts = [page.read_text(encoding="utf-8") for page in pages]
    found = {name for text in texts for name in re.findall(r"benchmarks/results/([\w-]+)\.md", text)}
    return sorted(found - {"tried"})  # a history in words


def revision_of(result: str) -> str | None:
    """The revision that a result names, with `-dirty` if the tree had been changed; None if it names none."""
    text = (ROOT / f"benchmarks/results/{result}.md").read_text(encoding="utf-8")
    found = re.search(r"^- revision: (\S+)$", text, re.MULTILINE)
    return found[1] if found else None


def fault_of(result: str) -> str | None:
    """Why a result can't be repeated, as far as its own words tell."""
    revision = revision_of(result)
    if revision is None:
        return "names no revision"
    return "is of a tree that had been changed" if revision.endswith("-dirty") else None


def git(*words: str) -> subprocess.CompletedProcess[str]:
    """A command of git in the repository."""
    return subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=False)


def main() -> None:
    """Look at each cited result."""
    is_faulty = False
    for result in cited_results():
        revision, fault = revision_of(result), fault_of(result)
        if (
            revision is not None
            and git("merge-base", "--is-ancestor", revision.removesuffix("-dirty"), "HEAD").returncode
        ):
            fault = f"names {revision}, which is not in the history"
        if fault is not None:
            is_faulty = True
            print(f"faulty: {result} {fault}; measure again: python {measured_by(result)[0]}")
            continue
        paths = [path.as_posix() for path in measured_by(result)]
        since = git("log", "--oneline", f"{revision}..HEAD", "--", *paths).stdout.splitlines()
        if since:
            print(
                f"old:    {result} is of {revision}; {len(since)} commits since have changed what it measures"
            )
    sys.exit(is_faulty)


if __name__ == "__main__":
    main()
