"""Localise a photo in an exported COLMAP model by pycolmap alone: not a line of featuredb is imported.

    python tools/colmap_localise.py EXPORTED/MAP PHOTO

COLMAP's own SIFT of the photo goes into a copy of the exported `database.db`, COLMAP matches it with every
image and verifies, matched keypoints are points of the model, and COLMAP estimates the pose. The photo was
taken with one of the model's cameras (--camera-id). The answer is a JSON object: `cam_from_world` (3, 4) in
the model's frame, `center`, `matches` and `inliers`.
"""

import argparse
import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument(
        "folder", type=Path, help="of one map, as `featuredb export --format colmap` makes it"
    )
    parser.add_argument("photo", type=Path)
    parser.add_argument("--camera-id", type=int, default=1, help="of the model's cameras; default: 1")
    parser.add_argument("--max-side", type=int, default=1600, help="COLMAP's SIFT works at this size")
    args = parser.parse_args()
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
    model = pycolmap.Reconstruction(str(args.folder / "sparse"))
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        shutil.copy(args.folder / "database.db", database)
        pixels, points = matched(database, model, args.photo, args.camera_id, args.max_side)
    found = None
    if len(pixels) >= 4:
        options = pycolmap.AbsolutePoseEstimationOptions()
        options.ransac.max_error = 4.0
        options.ransac.random_seed = 0
        found = pycolmap.estimate_and_refine_absolute_pose(
            pixels, points, model.camera(args.camera_id), options
        )
    json.dump(answer(found, len(pixels)), sys.stdout)
    sys.stdout.write("\n")
    return 0 if found is not None else 1


def matched(
    database: Path, model: Any, photo: Path, camera_id: int, max_side: int
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (m, 2) of the photo and the model's points (m, 3) that COLMAP's verified matches pair."""
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = max_side
    extraction.use_gpu = False
    reader = pycolmap.ImageReaderOptions()
    reader.existing_camera_id = camera_id
    pycolmap.extract_features(
        str(database),
        str(photo.parent),
        image_names=[photo.name],
        camera_mode=pycolmap.CameraMode.AUTO,
        reader_options=reader,
        extraction_options=extraction,
    )
    listed = database.with_name("pairs.txt")
    names = [image.name for _, image in sorted(model.images.items())]
    listed.write_text("".join(f"{photo.name} {name}\n" for name in names))
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(listed)
    pycolmap.match_image_pairs(str(database), matching_options=matching, pairing_options=pairing)
    return pairs(database, model, photo.name)


def pairs(database: Path, model: Any, name: str) -> tuple[np.ndarray, np.ndarray]:
    """A keypoint is paired with every point that an inlier match leads to; RANSAC chooses."""
    opened = pycolmap.Database.open(str(database))
    try:
        query = opened.read_image_with_name(name).image_id
        keypoints = opened.read_keypoints(query)[:, :2].astype(np.float64)
        found = set()
        for image_id, image in sorted(model.images.items()):
            if not opened.exists_two_view_geometry(query, image_id):
                continue
            for mine, theirs in opened.read_two_view_geometry(query, image_id).inlier_matches:
                point = image.points2D[int(theirs)]
                if point.has_point3D():
                    found.add((int(mine), int(point.point3D_id)))
    finally:
        opened.close()
    rows = sorted(found)
    pixels = keypoints[[row for row, _ in rows]].reshape(-1, 2)
    points = np.array([model.point3D(point).xyz for _, point in rows]).reshape(-1, 3)
    return pixels, points


def answer(found: dict[str, Any] | None, matches: int) -> dict[str, Any]:
    """As JSON holds it; without a pose, the number of matches alone."""
    if found is None:
        return {"cam_from_world": None, "matches": matches, "inliers": 0}
    pose = np.asarray(found["cam_from_world"].matrix())
    return {
        "cam_from_world": pose.tolist(),
        "center": (-pose[:, :3].T @ pose[:, 3]).tolist(),
        "matches": matches,
        "inliers": int(np.sum(found["inlier_mask"])),
    }


if __name__ == "__main__":
    sys.exit(main())
