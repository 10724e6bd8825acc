"""OpenSfM's own equations, written down here from its documentation, give the map's pixels and places."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from featuredb.errors import ExportError
from featuredb.export.formats.opensfm import opensfm_camera, write_opensfm
from featuredb.export.job import ExportJob
from featuredb.export.selection import Selection
from featuredb.geometry.camera import Camera
from featuredb.store import Database
from tests.support.scanned_map import scanned_map


def opensfm_pixels(camera: dict[str, Any], points_cam: np.ndarray) -> np.ndarray:
    """Normalised image coordinates as OpenSfM's documentation has them, then COLMAP's pixels."""
    x, y, z = points_cam.T
    kind = camera["projection_type"]
    fx = camera.get("focal", camera.get("focal_x"))
    fy = camera.get("focal", camera.get("focal_y"))
    cx, cy = camera.get("c_x", 0.0), camera.get("c_y", 0.0)
    k1, k2, k3, k4 = (camera.get(f"k{i}", 0.0) for i in (1, 2, 3, 4))
    if kind == "fisheye_opencv":
        r = np.hypot(x, y)
        theta = np.arctan2(r, z)
        d = 1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8
        u, v = fx * d * theta * x / r + cx, fy * d * theta * y / r + cy
    else:
        assert kind in ("perspective", "brown")
        xn, yn = x / z, y / z
        r2 = xn**2 + yn**2
        d = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        p1, p2 = camera.get("p1", 0.0), camera.get("p2", 0.0)
        tx = 2 * p1 * xn * yn + p2 * (r2 + 2 * xn**2)
        ty = 2 * p2 * xn * yn + p1 * (r2 + 2 * yn**2)
        u, v = fx * (d * xn + tx) + cx, fy * (d * yn + ty) + cy
    size = max(camera["width"], camera["height"])
    # Their pixels count from the centre of the top-left pixel, COLMAP's from its corner.
    pixels = np.column_stack([u * size + (camera["width"] - 1) / 2, v * size + (camera["height"] - 1) / 2])
    return pixels + 0.5


CAMERAS = [
    Camera(model="SIMPLE_PINHOLE", width=1000, height=800, params=(900.0, 500.0, 400.0)),
    Camera(model="PINHOLE", width=1000, height=800, params=(900.0, 910.0, 507.0, 395.0)),
    Camera(model="SIMPLE_RADIAL", width=800, height=1000, params=(900.0, 400.0, 500.0, 0.03)),
    Camera(model="RADIAL", width=1000, height=800, params=(900.0, 510.0, 400.0, 0.03, -0.01)),
    Camera(model="OPENCV", width=1000, height=800, params=(900, 905, 510, 400, 0.03, -0.01, 1e-3, -2e-3)),
    Camera(
        model="FULL_OPENCV",
        width=1000,
        height=800,
        params=(900, 905, 510, 400, 0.03, -0.01, 1e-3, -2e-3, 0.004, 0, 0, 0),
    ),
    Camera(model="SIMPLE_RADIAL_FISHEYE", width=1000, height=800, params=(500.0, 510.0, 400.0, 0.02)),
    Camera(model="RADIAL_FISHEYE", width=1000, height=800, params=(500.0, 510.0, 400.0, 0.02, -0.003)),
    Camera(
        model="OPENCV_FISHEYE", width=1000, height=800, params=(500, 505, 510, 400, 0.02, -3e-3, 1e-3, 2e-4)
    ),
]


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
def test_every_lens_draws_the_same_pixels(camera: Camera) -> None:
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (50, 2)), np.ones(50)]) * rng.uniform(1, 20, (50, 1))
    np.testing.assert_allclose(
        opensfm_pixels(opensfm_camera(camera), points), camera.project(points), atol=1e-9
    )


def test_a_lens_that_opensfm_cannot_have_is_refused() -> None:
    rational = replace(CAMERAS[5], params=(*CAMERAS[5].params[:9], 0.1, 0.0, 0.0))
    with pytest.raises(ExportError, match="no camera for FULL_OPENCV"):
        opensfm_camera(rational)


def test_the_folder_is_a_reconstruction_of_the_same_place(tmp_path: Path) -> None:
    feature_map = scanned_map(points=300).feature_map
    database = Database.create(tmp_path / "maps.db")
    database.commit_map(feature_map)
    job = ExportJob(
        database=database, snapshot=database.snapshot(), selection=Selection(), out=tmp_path / "out"
    )
    write_opensfm(job)
    folder = tmp_path / "out" / "scanned"
    (reconstruction,) = json.loads((folder / "reconstruction.json").read_text())
    reference = json.loads((folder / "reference_lla.json").read_text())
    assert reconstruction["reference_lla"] == reference
    frame = feature_map.frame
    assert reference == {
        "latitude": frame.latitude_deg, "longitude": frame.longitude_deg, "altitude": frame.height_m,
    }  # fmt: skip
    xyz = np.array([reconstruction["points"][str(k)]["coordinates"] for k in range(300)])
    np.testing.assert_allclose(frame.utm_from_enu(xyz, feature_map.epsg), feature_map.points.utm, atol=1e-6)

    with (folder / "tracks.csv").open(encoding="utf-8", newline="") as file:
        assert file.readline() == "OPENSFM_TRACKS_VERSION_v1\n"
        tracks = list(csv.reader(file, delimiter="\t"))
    assert len(tracks) == len(feature_map.observations)
    seen = feature_map.observations
    by_id = {image.image_id: image for image in feature_map.images}
    for row, (name, track, _, x, y, *_) in enumerate(tracks):
        image = by_id[int(seen.image_id[row])]
        assert name == image.name
        shot = reconstruction["shots"][name]
        camera = reconstruction["cameras"][shot["camera"]]
        in_camera = Rotation.from_rotvec(shot["rotation"]).apply(xyz[int(track)]) + shot["translation"]
        observed = np.array([float(x), float(y)]) * 1200 + [600, 450]
        theirs = opensfm_pixels(camera, in_camera[None])[0] - observed
        point = (
            image.cam_from_local.act(feature_map.points_local()[seen.point_index[row]]) if row < 40 else None
        )
        if point is not None:
            ours = feature_map.cameras[0].project(point)[0] - seen.xy[row]
            np.testing.assert_allclose(theirs, ours, atol=1e-4)
        assert np.linalg.norm(theirs) < 3.0
