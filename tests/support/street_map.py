"""A made street with houses on both sides: its scan from the air, and maps of photos by people there."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import GeoPrior, MapObservations
from featuredb.maps.unplaced_map import OwnFrame, OwnPoints, UnplacedMap
from featuredb.simworld.camera.photograph import look_pose
from ingest.register.anchor.ground import place
from tests.support.maps import random_unplaced_map
from tests.support.scanned_map import FRAME

# West, south, east, north, height of houses around a crossing, metres.
_HOUSES = (
    (-40.0, 6.0, -22.0, 18.0, 7.0),
    (-17.0, 8.0, -4.0, 20.0, 11.0),
    (5.0, 5.0, 13.0, 24.0, 9.0),
    (17.0, 7.5, 38.0, 17.0, 6.0),
    (-36.0, -20.0, -12.0, -6.0, 8.5),
    (-8.0, -17.0, -3.0, -5.0, 5.0),
    (6.0, -22.0, 26.0, -7.0, 12.0),
    (30.0, -16.0, 41.0, -5.0, 7.5),
)
_TILT = so3_exp([0.02, -0.03, 0.0])
OWN_FROM_LOCAL = Sim3(
    scale=2.7, rotation=_TILT @ so3_exp([0.0, 0.0, 1.9]), translation=np.array([30.0, -80.0, 12.0])
)


def _ground(xy: FloatArray) -> FloatArray:
    return np.asarray(0.02 * xy[:, 0] - 0.01 * xy[:, 1])


def few_sizes(patch: pytest.MonkeyPatch) -> None:
    """The street is sought at sizes at which its fronts are 5 to 50 m away, by fewer of its points."""
    patch.setattr(place, "_NEAREST_M", 5.0)
    patch.setattr(place, "_FURTHEST_M", 50.0)
    patch.setattr(place, "_COARSE", 250)


def street_scan() -> FloatArray:
    """(n, 3) of the ground and the roofs, in FRAME."""
    rng = np.random.default_rng(3)
    xy = rng.uniform(-70.0, 70.0, (110_000, 2))
    z = _ground(xy)
    for west, south, east, north, high in _HOUSES:
        inside = (xy[:, 0] > west) & (xy[:, 0] < east) & (xy[:, 1] > south) & (xy[:, 1] < north)
        z[inside] = high
    return np.column_stack([xy, z + rng.normal(0, 0.02, len(z))])


def _street_points(rng: np.random.Generator) -> FloatArray:
    """(n, 3) on the fronts along the street from west to east, and on its ground."""
    parts = []
    for west, south, east, north, high in _HOUSES:
        y = south if south > 0 else north
        along = rng.uniform(west, east, 260)
        parts.append(np.column_stack([along, np.full(260, y), rng.uniform(0.3, high, 260)]))
        for x in (west, east):
            deep = y + np.sign(y) * rng.uniform(0.0, 5.0, 60)
            parts.append(np.column_stack([np.full(60, x), deep, rng.uniform(0.3, high, 60)]))
    ground = np.column_stack([rng.uniform(-38, 38, 400), rng.uniform(-4.5, 4.5, 400), np.zeros(400)])
    ground[:, 2] = _ground(ground[:, :2])
    return np.vstack([*parts, ground])


def street_map(mirrored: bool) -> UnplacedMap:
    """Sixteen photos of the street, level within two degrees, geotags of 10 m on a half of them."""
    rng = np.random.default_rng(5)
    points = _street_points(rng)
    points += rng.normal(0, 0.02, points.shape)
    poses = [
        look_pose(
            np.array([x, rng.uniform(-3, 3), 1.6 + 0.02 * x]), 0.0 if k % 2 else 180.0, rng.normal(3, 2)
        )
        for k, x in enumerate(np.linspace(-32.0, 32.0, 16))
    ]
    observed = [
        np.flatnonzero((points @ pose.rotation[2] > pose.center @ pose.rotation[2] + 1.0)
                       & (np.linalg.norm(points - pose.center, axis=1) < 22.0))
        for pose in poses
    ]  # fmt: skip
    flip = np.array([-1.0, 1.0, 1.0]) if mirrored else np.ones(3)
    base = random_unplaced_map()
    images = []
    for k, pose in enumerate(poses):
        lat, lon, _ = FRAME.geodetic_from_enu(pose.center + rng.normal(0, (10.0, 10.0, 0.0)))
        tag = GeoPrior(
            latitude_deg=float(lat),
            longitude_deg=float(lon),
            height_m=None,
            sigma_horizontal_m=10.0,
            sigma_vertical_m=30.0,
        )
        turned = replace(pose, translation=-pose.rotation @ (pose.center * flip))
        images.append(
            replace(
                base.images[0],
                image_id=k,
                name=f"{k}.jpg",
                cam_from_local=OWN_FROM_LOCAL.act_on_pose(turned),
                covariance=None,
                gps=tag if k % 2 else None,
            )
        )
    n = sum(map(len, observed))
    return replace(
        base,
        frame=OwnFrame(metric=False, upright=True),
        images=tuple(images),
        points=OwnPoints(
            xyz=OWN_FROM_LOCAL.act(points * flip),
            rgb=np.zeros((len(points), 3), np.uint8),
            track_length=np.full(len(points), 3, np.int32),
            error_px=np.full(len(points), 0.5, np.float32),
            covariance=np.zeros((len(points), 6), np.float32),
        ),
        observations=MapObservations(
            point_index=np.concatenate(observed),
            image_id=np.repeat(np.arange(16), [len(seen) for seen in observed]).astype(np.int32),
            xy=np.zeros((n, 2), np.float32),
            scale=np.ones(n, np.float32),
            angle=np.zeros(n, np.float32),
            has_descriptor=np.zeros(n, dtype=bool),
            descriptors=np.zeros((n, 128), np.uint8),
        ),
    )


JOIN = Sim3(scale=1.0, rotation=so3_exp([0.0, 0.0, 1.3]), translation=np.array([60.0, 25.0, 0.0]))


def joined_wrongly(one: UnplacedMap) -> UnplacedMap:
    """A map with its own copy at another place of its frame, tied by points that a photo of each sees."""
    points, seen = len(one.points), one.observations
    again = [
        replace(i, image_id=i.image_id + 16, name=f"again {i.name}", gps=None,
                cam_from_local=JOIN.act_on_pose(i.cam_from_local))
        for i in one.images
    ]  # fmt: skip
    tie = np.flatnonzero(seen.image_id == 0)[:20]
    rows = np.concatenate([np.arange(len(seen.point_index)), np.arange(len(seen.point_index)), tie])
    both = seen.take(rows)
    index, image = both.point_index.copy(), both.image_id.copy()
    second = slice(len(seen.point_index), 2 * len(seen.point_index))
    index[second] += points
    image[second] += 16
    image[second.stop :] = 16
    columns = {
        name: np.concatenate([getattr(one.points, name)] * 2)
        for name in ("rgb", "track_length", "error_px", "covariance")
    }
    xyz = np.vstack([one.points.xyz, JOIN.act(one.points.xyz)])
    return replace(
        one,
        images=(*one.images, *again),
        points=OwnPoints(xyz=xyz, **columns),
        observations=replace(both, point_index=index, image_id=image),
    )
