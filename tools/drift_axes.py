"""How the maps of a walk lie against the truth, axis by axis, beside what their covariances claim.

    python -m tools.drift_axes DB WORLD [--version N]

WORLD is the album of the simulated world that DB has grown by (`tools/growth_walk.py` keeps both). A line a
map, in the order of growth: median error of its photos' places east, north, up (metres) with the standard
deviation that the placement claims there, and the median turn of its photos about east, north, up
(milliradians; about up is the azimuth) with that of the placement. --version asks an earlier state, the one
before the second anchor for example (`featuredb history DB`).
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from featuredb.geometry.sim3 import point_jacobian
from featuredb.store import Database
from tools.growth_common import open_album, registered, table


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    database, album = Database.open(args.db), open_album(args.world)
    found = [r for r in registered(database, album, args.version) if r.offset_m is not None]
    snapshot = database.snapshot(args.version)
    rows = []
    for summary in sorted(snapshot.maps(), key=lambda m: (m.generation, m.map_id)):
        mine = [r for r in found if r.map_id == summary.map_id]
        if not mine:
            continue
        feature_map = snapshot.load_map(summary.map_id)
        covariance = feature_map.placement.covariance
        jacobian = point_jacobian(np.array([i.cam_from_local.center for i in feature_map.images]))
        claimed = jacobian @ covariance @ np.swapaxes(jacobian, -1, -2)
        sigma = np.sqrt(np.median(np.diagonal(claimed, axis1=1, axis2=2), axis=0))
        turn = 1e3 * np.median([r.turn_rad for r in mine if r.turn_rad is not None], axis=0)
        turns = 1e3 * np.sqrt(np.diag(covariance)[1:4])
        off = np.median([r.offset_m for r in mine], axis=0)
        rows.append(
            (
                *(summary.map_id[:8], summary.generation, summary.status, len(mine)),
                *(*off.tolist(), *sigma.tolist(), *turn.tolist(), *turns.tolist()),
            )
        )
    head = ("map", "gen", "status", "photos", "e m", "n m", "u m", "se m", "sn m", "su m")
    turned = ("re mrad", "rn mrad", "ru mrad", "sre", "srn", "sru")
    sys.stdout.write(table(rows, (*head, *turned)) + "\n")
    return 0


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("db", type=Path)
    parser.add_argument("world", type=Path, help="folder of the album")
    parser.add_argument("--version", type=int, default=None, help="of the database; default: the newest")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
