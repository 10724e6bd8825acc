"""A block for tests of the adjustment, with known truth, and all terms that an adjustment may have."""

import numpy as np

from featuredb.adjust.terms import (
    Block,
    CenterPriors,
    LensWidths,
    Marks,
    Terms,
    lens_prior,
    surface_priors,
)
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3

WIDTHS = LensWidths(focal_rel=0.02, aspect_rel=0.001, center_rel=0.01, radial=0.05, tangential=0.003)
TRUE = Camera(
    model="OPENCV", width=1200, height=900, params=(1010.0, 1009.5, 608.0, 446.0, 0.03, -0.01, 5e-4, -3e-4)
)


def adjusted_block(seed: int = 0, points: int = 60, noise_px: float = 0.0) -> Block:
    """Eight photos on two heights that look down on hills, each point in all of them."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-8, -6, -2], [8, 6, 2], (points, 3))
    poses = []
    for k in range(8):
        center = np.array([6 * np.cos(k), 6 * np.sin(k), 18.0 + 3 * (k % 2)])
        turn = Rigid3.exp(np.concatenate([rng.normal(0, 0.08, 3), np.zeros(3)])).rotation
        rotation = turn @ np.diag([1.0, -1.0, -1.0])
        poses.append(Rigid3(rotation=rotation, translation=-rotation @ center))
    photo_of, point_of = (a.ravel() for a in np.meshgrid(np.arange(8), np.arange(points)))
    pixels = np.concatenate([TRUE.project(pose.act(xyz)) for pose in poses]).reshape(8, points, 2)
    xy = pixels[photo_of, point_of] + rng.normal(0, 1, (len(photo_of), 2)) * noise_px
    return Block(
        names=tuple(f"{k}" for k in range(8)),
        cameras=(TRUE,),
        camera_of=np.zeros(8, np.int64),
        cam_from_block=tuple(poses),
        xyz=xyz,
        point_of=point_of.astype(np.int64),
        photo_of=photo_of.astype(np.int64),
        xy=xy,
    )


def adjusted_terms(block: Block, lens: Camera, keypoint_px: float = 0.5) -> Terms:
    """All terms: positions, control that two photos show, a surface below half of the points."""
    seen = block.cam_from_block[2].act(block.xyz[:9])
    offset = np.where(np.arange(len(block.xyz)) % 2 == 0, 0.0, np.nan)
    return Terms(
        keypoint_px=keypoint_px,
        lenses=(lens_prior(lens, WIDTHS),),
        marks=Marks(xyz=block.xyz[:9], photo_of=np.full(9, 2, np.int64), xy=TRUE.project(seen), sigma_px=1.0),
        points=surface_priors(block.xyz, offset, np.tile([0.0, 0.0, 1.0], (len(block.xyz), 1)), 0.05),
        centers=CenterPriors(
            photo_of=np.arange(8), xyz=block.centers(), covariance=np.tile(np.eye(3) * 0.05**2, (8, 1, 1))
        ),
    )
