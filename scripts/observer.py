"""Writes the CIE 1931 2 degree colour matching functions that the package ships, as colour-science has them.

    python scripts/observer.py

Importing colour-science takes as long as all else that opening a run needs, for these 471 rows of three numbers.
"""

from pathlib import Path

from colour.colorimetry import MSDS_CMFS

TARGET = Path(__file__).parents[1] / "unmix_plugin/spectral/colour/cie_1931_2_degree.csv"


def main() -> None:
    """Write the table, each number as short as reads back equal."""
    observer = MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    rows = zip(observer.wavelengths.tolist(), observer.values.tolist(), strict=True)
    lines = [f"{nm:g},{','.join(map(repr, values))}" for nm, values in rows]
    TARGET.write_text("\n".join(["wavelength,x,y,z", *lines, ""]), encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
