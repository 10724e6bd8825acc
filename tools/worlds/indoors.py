"""Rooms that belong to no town: indoor shots, and portraits in front of a blurred wall."""

import cv2
import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.photograph import Device, SensorOptions, expose, look_pose, scene_look
from featuredb.simworld.camera.raster import render
from featuredb.simworld.town.blocks import box, face
from featuredb.simworld.town.scene import Ellipsoids, Faces, Scene
from featuredb.simworld.town.texture import Image8

_SKIN = (1.9, 1.25, 1.9)  # factors on the leaf texture's green


def indoor_photo(scene: Scene, device: Device, seed: int, sensor: SensorOptions) -> Image8:
    """A room (h, w, 3) uint8 that nobody else has; `scene` lends its textures only."""
    rng = np.random.default_rng((seed, 95))
    size = rng.uniform(4.0, 7.0, 2)
    faces = _room(rng, size)
    plants = _balls(rng.uniform([-0.4, -0.4, 0.5], [0.4, 0.4, 1.3], (3, 3)) * [*size, 1.0], 0.25, rng)
    centre = np.array([*(rng.uniform(-0.25, 0.25, 2) * size), rng.uniform(1.4, 1.7)])
    pose = look_pose(centre, float(rng.uniform(0, 360)), float(rng.normal(-8, 6)), float(rng.normal(0, 2)))
    return expose(_draw(scene, faces, plants, device, pose), rng, sensor)


def portrait_photo(scene: Scene, device: Device, seed: int, sensor: SensorOptions) -> Image8:
    """A person who fills the frame, in a room out of focus."""
    rng = np.random.default_rng((seed, 96))
    size = rng.uniform(4.0, 7.0, 2)
    pose = look_pose((0.0, -0.3 * size[1], 1.55), float(rng.normal(0, 8)), float(rng.normal(-3, 2)))
    wall = _draw(scene, _room(rng, size), _balls(np.zeros((0, 3)), 0.2, rng), device, pose)
    wall = np.asarray(cv2.GaussianBlur(wall, (0, 0), 0.012 * device.camera.width), dtype=np.uint8)
    ahead = pose.inverse().rotation[:, 2]
    at = pose.center + ahead * float(rng.uniform(0.9, 1.4)) + rng.normal(0, [0.12, 0.0, 0.0])
    body = at + np.array([[0, 0, 0.02], [0, 0, -0.45], [0, 0.03, 0.10]])
    radii = np.array([[0.105, 0.12, 0.145], [0.26, 0.16, 0.36], [0.115, 0.125, 0.11]])
    cloth, hair = rng.uniform(0.2, 2.2, 3), rng.uniform(0.3, 1.2, 3)
    person = Ellipsoids(
        center=body,
        radii=radii,
        tint=np.array([_SKIN, cloth, hair]),
        texture_uv=rng.uniform(0, 500, (3, 2)),
        object_id=np.arange(1, 4, dtype=np.int32),
    )
    rendered = render(
        Faces.concatenate([]), person, device.camera, pose, look=scene_look(scene), supersample=2
    )
    assert rendered.rgb is not None
    skin = cv2.GaussianBlur(rendered.rgb, (0, 0), 2.0)
    seen = np.isfinite(rendered.depth)[..., None]
    return expose(np.where(seen, skin, wall).astype(np.uint8), rng, sensor)


def _draw(scene: Scene, faces: Faces, balls: Ellipsoids, device: Device, pose: Rigid3) -> Image8:
    rendered = render(faces, balls, device.camera, pose, look=scene_look(scene), supersample=2)
    assert rendered.rgb is not None
    return rendered.rgb


def _room(rng: np.random.Generator, size: FloatArray) -> Faces:
    """Walls, floor, ceiling, pictures, furniture; the floor's middle at the origin."""
    x, y, z = 0.5 * size[0], 0.5 * size[1], float(rng.uniform(2.4, 3.0))
    wall = tuple(float(c) for c in rng.uniform(0.75, 1.2, 3))
    corners = np.array([[-x, -y, 0], [-x, y, 0], [x, y, 0], [x, -y, 0]])
    parts = [
        face(
            corners[0], corners[3] - corners[0], corners[1] - corners[0], "wood", 1, detail=_start(rng)
        ),  # floor
        face((-x, -y, z), (0, 2 * y, 0), (2 * x, 0, 0), "plain", 2, tint=(1.15,) * 3),  # ceiling
    ]
    for i in range(4):
        start, edge = corners[i], corners[(i + 1) % 4] - corners[i]
        parts.append(face(start, edge, (0, 0, z), "plain", 3 + i, detail=_start(rng), tint=wall))
        inward = np.cross(edge, [0, 0, 1]) / np.linalg.norm(edge)
        for _ in range(int(rng.integers(1, 4))):  # pictures on the wall
            w, h = rng.uniform(0.3, 1.0, 2)
            along = rng.uniform(0.1, 0.9 - w / np.linalg.norm(edge)) * edge
            origin = start + along + inward * 0.02 + [0, 0, rng.uniform(1.0, z - h - 0.1)]
            tint = tuple(float(c) for c in rng.uniform(0.3, 1.3, 3))
            texture = str(rng.choice(["leaves", "fields", "wood", "car"]))
            unit = edge / np.linalg.norm(edge)
            parts.append(face(origin, w * unit, (0, 0, h), texture, 20, detail=_start(rng), tint=tint))
    for i in range(int(rng.integers(4, 9))):
        w, d, h = rng.uniform([0.4, 0.4, 0.4], [1.8, 1.0, 1.9])
        at = rng.uniform(-0.45, 0.45, 2) * size
        away = float(np.linalg.norm(at))
        if away < 1.5:
            at *= 1.5 / max(away, 0.3)
        tint = tuple(float(c) for c in rng.uniform(0.4, 1.2, 3))
        parts.append(
            box(
                float(at[0]),
                float(at[1]),
                0.0,
                (float(w), float(d), float(h)),
                30 + i,
                yaw_deg=float(rng.choice([0, 90])),
                texture=str(rng.choice(["wood", "plain"])),
                detail=_start(rng),
                tint=tint,
            )
        )
    return Faces.concatenate(parts)


def _start(rng: np.random.Generator) -> tuple[float, float]:
    return float(rng.uniform(0, 500)), float(rng.uniform(0, 500))


def _balls(centers: FloatArray, radius: float, rng: np.random.Generator) -> Ellipsoids:
    n = len(centers)
    return Ellipsoids(
        center=np.reshape(centers, (n, 3)),
        radii=radius * rng.uniform(0.7, 1.3, (n, 3)),
        tint=rng.uniform(0.8, 1.2, (n, 3)),
        texture_uv=rng.uniform(0, 500, (n, 2)),
        object_id=np.arange(100, 100 + n, dtype=np.int32),
    )
