"""What does the scan say of grown maps that are right, and of the same maps moved?

    python -m tools.scan_check_study --db DB

DB is a database with grown maps that are known to be right (a simulated one) and a scan of the place. Prints
for each map, as it is and moved in plan and in height, the figure of the gate `scan`
(`ingest/growth/scan_check.py`): below its limit as it is, and above where it is moved by much more than it
claims, as far as roofs hold it.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from featuredb.geometry.sim3 import Sim3, point_jacobian
from featuredb.maps.move import move_map
from featuredb.store import Database
from ingest.growth.scan_check import ScanCheckOptions, scan_gate
from tools.growth_common import table

_MOVES_M = (1.0, 2.0, 10.0)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--db", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=1, help="of the directions in plan")
    args = parser.parse_args(argv)
    database, options = Database.open(args.db), ScanCheckOptions()
    rng = np.random.default_rng(args.seed)
    snapshot = database.snapshot()
    rows, limit = [], float("nan")
    for summary in snapshot.maps():
        feature_map = snapshot.load_map(summary.map_id)
        jacobian = point_jacobian(np.median(feature_map.points_local(), axis=0))
        spread = jacobian @ feature_map.placement.covariance @ jacobian.T
        angle = rng.uniform(0, 2 * np.pi)
        aside, up = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([0.0, 0.0, 1.0])
        figures: list[float] = []
        for shift in [np.zeros(3), *(m * d for d in (aside, up) for m in _MOVES_M)]:
            move = Sim3(scale=1.0, rotation=np.eye(3), translation=shift)
            gate, _ = scan_gate(database, move_map(feature_map, move), options)
            limit = limit if gate is None else gate.limit
            figures.append(float("nan") if gate is None else gate.figure)
        claim = 1.96 * float(np.sqrt(np.linalg.eigvalsh(spread)[-1]))
        rows.append((summary.map_id[:8], summary.generation, len(feature_map.images), claim, *figures))
    moves = [f"{name} {m:g} m" for name in ("plan", "up") for m in _MOVES_M]
    sys.stdout.write(table(rows, ("map", "gen", "photos", "95 % m", "as it is", *moves)) + "\n")
    sys.stdout.write(f"limit {limit:.1f}; nan: the scan says nothing\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
