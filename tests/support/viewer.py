"""A small database to look at, its photos, and a running viewer of it."""

import hashlib
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import requests

from featuredb.geo.geopose import geopose_from_camera
from featuredb.geometry.rotation import quaternion_from_matrix
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from reloc.listening import listen, uvicorn_server
from reloc.tracking.ground import EarthPose
from reloc.tracking.trajectory.files import write_trajectory
from reloc.tracking.trajectory.values import Trajectory, TrajectoryPoint
from reloc.viewer.photos import Pictures, Queries
from reloc.viewer.scene import ViewerScene, build_scene
from reloc.viewer.server import HOST, create_app
from tests.support.maps import random_map
from tests.support.planar_map import EPSG, field_texture, planar_map, render, view

QUERY_POSE = view(4, -6, 40, 10, 33)
MISSING = "8.png"  # a photo of the map that is not in the folder


@dataclass(frozen=True)
class ViewerWorld:
    """What the tests look at.

    `field` is active and answers; `child` stands on it, in quarantine; `old` is retired.
    """

    database: Database
    photos: Path
    field: FeatureMap
    query: Path
    elsewhere: Path
    track: Path


def make_world(folder: Path) -> ViewerWorld:
    """Everything below `folder`."""
    texture, photos = field_texture(1), folder / "photos"
    photos.mkdir(parents=True)
    field = planar_map(1)
    images = []
    for image in field.images:
        data = png(render(texture, image.cam_from_local, seed=image.image_id))
        images.append(
            replace(
                image, sha256=hashlib.sha256(data).hexdigest(), owner="Ann & <b>Bo</b>", licence="CC-BY-4.0"
            )
        )
        if image.name != MISSING:
            (photos / image.name).write_bytes(data)
    rgb = np.tile(np.array([200, 60, 40], np.uint8), (len(field.points), 1))
    field = replace(field, images=tuple(images), points=replace(field.points, rgb=rgb))
    database = Database.create(folder / "maps.db")
    database.commit_map(field)
    child = random_map(3, map_id="child", points=400, extent_m=60.0, parents=("field",))
    database.commit_map(child.with_status("quarantined"))
    database.commit_map(random_map(4, map_id="old", points=50, extent_m=60.0))
    database.retire("old", "a better one is there")
    query, elsewhere = folder / "query.png", folder / "elsewhere.png"
    query.write_bytes(png(render(texture, QUERY_POSE, seed=50)))
    elsewhere.write_bytes(png(render(field_texture(9), QUERY_POSE, seed=51)))
    track = folder / "track.csv"
    write_trajectory(track, track_over(field))
    return ViewerWorld(database, photos, field, query, elsewhere, track)


def png(gray: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".png", gray)[1])


def track_over(field: FeatureMap) -> Trajectory:
    """Eleven frames of 0.2 s from west to east over the field; 4 and 5 are lost, 6 is found again."""
    points = []
    for k in range(11):
        pose = view(-20.0 + 4.0 * k, 2.0, 40.0, 15.0, 90.0)
        lost = k in (4, 5)
        state = "lost" if lost else "relocalised" if k in (0, 6) else "tracking"
        earth = EarthPose(
            epsg=EPSG,
            utm=field.frame.utm_from_enu(pose.center, EPSG),
            height_datum=field.height_datum,
            cam_from_utm_xyzw=quaternion_from_matrix(
                pose.rotation @ field.frame.grid_from_enu(pose.center, EPSG).T
            ),
            geopose=geopose_from_camera(pose, field.frame),
            covariance=np.diag([1e-6, 1e-6, 1e-6, 0.01, 0.04, 0.09]),
            map_id=field.map_id,
        )
        points.append(
            TrajectoryPoint(
                index=k,
                time_s=0.2 * k,
                state=state,
                pose=None if lost else earth,
                inliers=0 if lost else 30 + k,
                detail="too dark" if lost else "",
            )
        )
    return Trajectory(source="film.mp4", points=tuple(points))


@contextmanager
def running_viewer(
    database: Database,
    scene: ViewerScene | None = None,
    photos: Path | None = None,
) -> Iterator[str]:
    """A viewer on a free port, in a thread of the test; gives its URL without a slash at the end."""
    scene = scene or build_scene(database, database.snapshot())
    server = uvicorn_server(create_app(scene, Pictures(photos), Queries(database, scene)))
    with listen(HOST, 0) as bound:
        thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]})
        thread.start()
        try:
            end = time.monotonic() + 20.0
            while not server.started:
                assert thread.is_alive(), "the viewer did not start"
                assert time.monotonic() < end, "the viewer did not start in time"
                time.sleep(0.01)
            yield f"http://127.0.0.1:{bound.getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join(30.0)
            assert not thread.is_alive(), "the viewer does not stop"


def get(url: str, **arguments: object) -> requests.Response:
    return requests.get(url, timeout=30, **arguments)  # type: ignore[arg-type]
