"""Writes README's results, from benchmarks/results/quality.json.

    python scripts/results_table.py

They stand between two comments. Scenes that settings were chosen on have a line each; of those that were drawn, on
which nothing is chosen, the mean and the worst of each column are given. `make results-table` measures first.
"""

from __future__ import annotations

import json
import statistics
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
README, RESULTS = ROOT / "README.md", ROOT / "benchmarks/results/quality.json"
BEGIN, END = "<!-- made by scripts/results_table.py -->\n\n", "\n<!-- end of what is made -->"
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


def introduction(report: dict[str, Any]) -> str:
    """What was measured, and how far it can be repeated."""
    setting, measured = report["setting"], report["measured"]
    limit = f"{setting['steps']:,} steps" if "steps" in setting else f"{setting['max_seconds']:g} s"
    lines = (
        f"Evaluation views of {len(measured)} rendered scenes after {limit} of training on two shared CPU cores.",
        "Only the number of endmembers was set ([all figures](benchmarks/results/quality.md)).",
        "No setting was chosen on drawn scenes. `make results-table` measures again, from a clone alone.",
    )
    return "\n".join([*lines, ""])


def table(measured: dict[str, Any]) -> str:
    """The table in Markdown, of the `measured` scenes of quality.json."""
    heads = ["scene", "bands", *(head for head, _, _ in COLUMNS.values())]
    lines = [heads]
    for name in (name for name in SCENES if name in measured):
        words, metrics = SCENES[name], measured[name]["metrics"]
        lines.append(
            [words, str(metrics["bands"]), *(f.format(metrics[k]) for k, (_, f, _) in COLUMNS.items())]
        )
    drawn = [values["metrics"] for name, values in measured.items() if _is_drawn(name)]
    if drawn:
        bands = "-".join(sorted({str(metrics["bands"]) for metrics in drawn}, key=int))
        means = [f.format(statistics.mean(m[k] for m in drawn)) for k, (_, f, _) in COLUMNS.items()]
        worst = [f.format(pick(m[k] for m in drawn)) for k, (_, f, pick) in COLUMNS.items()]
        lines += [
            [f"{len(drawn)} drawn scenes: mean", bands, *means],
            ["and the worst of each", bands, *worst],
        ]
    head, *rows = (f"| {' | '.join(cells)} |\n" for cells in lines)
    return "".join([head, "|---" * len(heads) + "|\n", *rows])


def _is_drawn(name: str) -> bool:
    return name.startswith("unseen-")


def with_results(readme: str, report: dict[str, Any]) -> str:
    """README's text with these results."""
    before, _, rest = readme.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}{introduction(report)}\n{table(report['measured'])}{END}{after}"


def main() -> None:
    """Rewrite README."""
    report = json.loads(RESULTS.read_text(encoding="utf-8"))
    README.write_text(with_results(README.read_text(encoding="utf-8"), report), encoding="utf-8")


if __name__ == "__main__":
    main()
