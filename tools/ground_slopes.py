"""How level is ground? Slopes of planes through windows of ground points of airborne scans.

    python tools/ground_slopes.py SCAN... [--window 60]

Prints the root mean square slope about one axis, in degrees: what placement by control points without heights
assumes of the ground under a block (`ingest.register.control.level.LevelOptions`).
"""

import argparse
import sys
from pathlib import Path

import laspy
import numpy as np
from numpy.typing import NDArray

_GROUND = 2
_MIN_POINTS = 200  # of a window: a plane wants more than a path through the wood


def slopes_deg(xyz: NDArray[np.float64], window: float) -> NDArray[np.float64]:
    """Slopes (k,) of planes through square windows that points (n, 3) fill."""
    cell = np.floor((xyz[:, :2] - xyz[:, :2].min(axis=0)) / window).astype(np.int64)
    found = []
    for corner in np.unique(cell, axis=0):
        inside = xyz[(cell == corner).all(axis=1)]
        if len(inside) < _MIN_POINTS or np.ptp(inside[:, :2], axis=0).min() < 0.8 * window:
            continue
        centred = np.column_stack([inside[:, :2] - inside[:, :2].mean(axis=0), np.ones(len(inside))])
        gradient = np.linalg.lstsq(centred, inside[:, 2], rcond=None)[0][:2]
        found.append(np.degrees(np.arctan(np.hypot(*gradient))))
    return np.array(found)


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scans", nargs="+", type=Path, metavar="SCAN")
    parser.add_argument("--window", type=float, default=60.0, help="metres; default: 60")
    args = parser.parse_args(arguments)
    for path in args.scans:
        scan = laspy.read(path)
        crs = scan.header.parse_crs()
        unit = crs.axis_info[0].unit_conversion_factor if crs is not None else 1.0
        ground = np.asarray(scan.classification) == _GROUND
        slopes = slopes_deg(scan.xyz[ground] * unit, args.window)
        rms = np.sqrt((slopes**2).mean() / 2.0) if len(slopes) else float("nan")
        sys.stdout.write(f"{path.name}: {len(slopes)} windows of {args.window:g} m, {rms:.1f} degrees\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
