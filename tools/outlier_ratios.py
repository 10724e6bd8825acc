"""How far points are from their neighbours, against how far those are from theirs: the distribution per scan.

    python tools/outlier_ratios.py FILE[=METRES_PER_UNIT]...

For choosing the ratio above which `featuredb lidar add` takes a point for an outlier.
"""

import argparse
from pathlib import Path

import numpy as np

from featuredb.lidar.las import read_points
from featuredb.lidar.outliers import OutlierOptions, outlier_ratio

CELL_M = 2.0
LARGEST_POINTS = 2_000_000
PERCENTILES = (50, 99, 99.9, 99.99)


def main() -> int:
    """Print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("files", nargs="+")
    options = OutlierOptions()
    print(f"| scan | points | {' | '.join(f'{p} %' for p in PERCENTILES)} | largest | alone | dropped |")
    print("|---|---|" + "---|" * (len(PERCENTILES) + 3))
    for name in parser.parse_args().files:
        path, _, unit = name.partition("=")
        xyz = next(read_points(Path(path), LARGEST_POINTS)).xyz * float(unit or 1.0)
        xyz -= xyz.min(axis=0)
        occupied = len(np.unique((xyz[:, :2] // CELL_M).astype(np.int64), axis=0))
        spacing = float(np.sqrt(occupied * CELL_M**2 / len(xyz)))
        ratio = outlier_ratio(xyz, len(xyz), options.reach_m(spacing), options)
        finite = ratio[np.isfinite(ratio)]
        figures = " | ".join(f"{v:.2f}" for v in (*np.percentile(finite, PERCENTILES), finite.max()))
        alone, dropped = int((~np.isfinite(ratio)).sum()), int((ratio > options.ratio).sum())
        print(f"| {Path(path).name} | {len(xyz)} | {figures} | {alone} | {dropped} |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
