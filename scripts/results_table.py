"""Write README's table of results, from benchmarks/results/quality.json.

    python scripts/results_table.py

The table stands between two comments. Scenes that settings were chosen on have a line each; of those that were drawn,
on which nothing is chosen, the mean and the worst of each column are given.
"""

from __future__ import annotations

import json
import statistics
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
README, RESULTS = ROOT / "README.md", ROOT / "benchmarks/results/quality.json"
BEGIN, END = "<!-- made by scripts/results_table.py -->\n\n", "\n<!-- end of the table -->"
SCENES = {
    "table": "objects on a table, alpha",
    "room": "inside a room, no alpha",
    "pots": "potted plants, visible and near infrared, alpha",
    "turntable": "plant turned before a lamp, noise, masks with errors",
    "outdoors": "statue outdoors, trees far behind it, no alpha",
}
"""What each scene shows."""
COLUMNS = {
    "psnr": ("PSNR", "{:.1f} dB", min),
    "psnr_matter": ("PSNR of the objects", "{:.1f} dB", min),
    "sam": ("spectral angle", "{:.3f} rad", max),
    "miou": ("mIoU of materials", "{:.2f}", min),
    "abundance_rmse": ("abundance RMSE", "{:.3f}", max),
}
"""By key of metrics.json: heading, format, and which of several values is the worst."""


def table(measured: dict[str, Any]) -> str:
    """The table in Markdown, of the `measured` scenes of quality.json."""
    heads = ["scene", "bands", *(head for head, _, _ in COLUMNS.values())]
    lines = [heads, ["---"] * len(heads)]
    for name, words in SCENES.items():
        metrics = measured[name]["metrics"]
        lines.append(
            [words, str(metrics["bands"]), *(f.format(metrics[k]) for k, (_, f, _) in COLUMNS.items())]
        )
    drawn = [values["metrics"] for name, values in measured.items() if name.startswith("unseen-")]
    if drawn:
        bands = "-".join(sorted({str(metrics["bands"]) for metrics in drawn}, key=int))
        means = [f.format(statistics.mean(m[k] for m in drawn)) for k, (_, f, _) in COLUMNS.items()]
        worst = [f.format(pick(m[k] for m in drawn)) for k, (_, f, pick) in COLUMNS.items()]
        lines += [
            [f"{len(drawn)} drawn scenes: mean", bands, *means],
            ["and the worst of each", bands, *worst],
        ]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def with_table(readme: str, measured: dict[str, Any]) -> str:
    """README's text with the table of these results."""
    before, _, rest = readme.partition(BEGIN)
    _, _, after = rest.partition(END)
    return before + BEGIN + table(measured) + END + after


def main() -> None:
    """Rewrite README."""
    measured = json.loads(RESULTS.read_text(encoding="utf-8"))["measured"]
    README.write_text(with_table(README.read_text(encoding="utf-8"), measured), encoding="utf-8")


if __name__ == "__main__":
    main()
