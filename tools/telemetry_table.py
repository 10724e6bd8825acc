"""What can be read of the telemetry files in a folder: a table for people, one line each.

    python -m tools.telemetry_table DIR

For each file: format and dialect, samples, samples with a position, first and last time (seconds of the
video, or since the first sample), bounds in degrees, and warnings; or the reason for which it is refused.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from featuredb.errors import TelemetryError
from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry import Telemetry, read_telemetry
from featuredb.video.telemetry.read import SIDECAR_SUFFIXES, VIDEO_SUFFIXES


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, metavar="DIR")
    folder: Path = parser.parse_args(argv).folder
    if not folder.is_dir():
        parser.error(f"{folder}: expected a folder")
    files = [file for file in folder.iterdir() if file.suffix.lower() in (*SIDECAR_SUFFIXES, *VIDEO_SUFFIXES)]
    print(
        "| file | dialect | samples | with fix | first s | last s | latitude | longitude | clock | remarks |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for file in sorted(files, key=lambda file: file.name.lower()):
        try:
            cells = _cells(read_telemetry(file))
        except TelemetryError as error:
            cells = ["refused", *[""] * 7, str(error)]
        print("| " + " | ".join([file.name, *cells]) + " |")
    return 0


def _cells(telemetry: Telemetry) -> list[str]:
    return [
        telemetry.source,
        str(len(telemetry)),
        str(int(telemetry.has_position.sum())),
        f"{telemetry.times_s[0]:.3f}",
        f"{telemetry.times_s[-1]:.3f}",
        _bounds(telemetry.latitude_deg),
        _bounds(telemetry.longitude_deg),
        telemetry.clock,
        "; ".join(telemetry.warnings),
    ]


def _bounds(degrees: FloatArray) -> str:
    low, high = np.nanmin(degrees), np.nanmax(degrees)
    return f"{low:.6f}" if low == high else f"{low:.6f} to {high:.6f}"


if __name__ == "__main__":
    sys.exit(main())
