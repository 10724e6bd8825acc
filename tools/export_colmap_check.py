"""Does an exported COLMAP model localise a photo as this system does?

    python tools/export_colmap_check.py DB PHOTO [--map ID] [--camera-id N]

The map is exported, a program of its own that imports NumPy and pycolmap only localises the photo in the
export, and its answer is compared with that of the database's own localiser, which is told the same camera.
Exit code 0 if both localise it and their positions differ by --max-m at most (5 cm), else 1.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from featuredb.export.attribution import folder_name
from featuredb.export.colmap import write_colmap
from featuredb.export.job import ExportJob
from featuredb.export.selection import Selection
from featuredb.features.decode import decode_gray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.store import Database
from reloc.localiser import Localiser
from reloc.result import LocaliseRequest

_PLAIN = Path(__file__).with_name("colmap_localise.py")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("db")
    parser.add_argument("photo", type=Path)
    parser.add_argument("--map", default=None, metavar="ID", help="default: the only active one")
    parser.add_argument("--camera-id", type=int, default=1, help="of the exported model; default: 1")
    parser.add_argument("--max-m", type=float, default=0.05, help="default: 0.05")
    args = parser.parse_args()
    database = Database.open(args.db)
    snapshot = database.snapshot()
    map_id = args.map or only(sorted(m.map_id for m in snapshot.maps() if m.status == "active"))
    feature_map = snapshot.load_map(map_id)
    with tempfile.TemporaryDirectory() as work:
        out = Path(work) / "out"
        write_colmap(
            ExportJob(database=database, snapshot=snapshot, selection=Selection(maps=(map_id,)), out=out)
        )
        theirs = by_colmap(out / folder_name(map_id), args.photo, args.camera_id)
    camera = feature_map.cameras[args.camera_id - 1]
    gray = decode_gray(args.photo.read_bytes())
    result = Localiser.open(database).localise(gray, LocaliseRequest(camera=camera, map_ids=(map_id,)))
    if result.pose is None or theirs["cam_from_world"] is None:
        sys.stdout.write(f"ours: {result.reason or 'localised'}; COLMAP: {theirs}\n")
        return 1
    ours = result.pose.cam_from_local @ result.pose.frame.enu_from(feature_map.frame)
    pose = Rigid3.from_matrix(theirs["cam_from_world"])
    apart = pose.center - ours.center
    distance = float(np.linalg.norm(apart))
    sys.stdout.write(
        f"{args.photo.name} in {map_id}: COLMAP alone {theirs['inliers']} inliers of {theirs['matches']}; "
        f"positions {100 * distance:.2f} cm apart (east, north, up "
        f"{', '.join(f'{100 * v:.2f}' for v in apart)} cm), rotations {pose.angle_to_deg(ours):.4f} deg\n"
    )
    return 0 if distance <= args.max_m else 1


def by_colmap(folder: Path, photo: Path, camera_id: int) -> dict[str, object]:
    """The answer of the program that knows pycolmap only, in a process of its own."""
    command = [sys.executable, "-I", str(_PLAIN), str(folder), str(photo.resolve())]
    done = subprocess.run(
        [*command, "--camera-id", str(camera_id)], capture_output=True, text=True, check=False
    )
    if done.returncode not in (0, 1) or not done.stdout:
        raise SystemExit(f"colmap_localise.py failed: {done.stderr}")
    answer: dict[str, object] = json.loads(done.stdout)
    return answer


def only(map_ids: list[str]) -> str:
    if len(map_ids) != 1:
        raise SystemExit(f"expected one active map or --map, found {', '.join(map_ids) or 'none'}")
    return map_ids[0]


if __name__ == "__main__":
    sys.exit(main())
