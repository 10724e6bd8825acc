"""Blocks of maps that have a place, and the way back."""

from dataclasses import replace

import numpy as np

from featuredb.adjust.terms import Block
from featuredb.geo.local_frame import LocalFrame
from featuredb.geo.utm import utm_epsg
from featuredb.maps.error_modes import without_modes
from featuredb.maps.feature_map import FeatureMap, Placement
from ingest.colmap.precision import (
    linearise,
    point_covariances,
    pose_covariances,
    residual_variance,
    upper_triangle,
)


def block_of_map(feature_map: FeatureMap) -> Block:
    """The block of a map, in the map's local frame."""
    observations = feature_map.observations
    return Block(
        names=tuple(image.name for image in feature_map.images),
        cameras=feature_map.cameras,
        camera_of=np.array([image.camera_id for image in feature_map.images], dtype=np.int64),
        cam_from_block=tuple(image.cam_from_local for image in feature_map.images),
        xyz=feature_map.points_local(),
        point_of=np.asarray(observations.point_index, dtype=np.int64),
        photo_of=feature_map.image_rows(observations.image_id),
        xy=observations.xy.astype(np.float64),
    )


def map_of_block(
    feature_map: FeatureMap, block: Block, frame: LocalFrame, placement: Placement, height_datum: str
) -> FeatureMap:
    """The map placed anew: poses, points and intrinsics of the block, which is in metres in `frame`.

    Errors and covariances are computed again, joint ones are lost; ids, descriptors and attribution stay.
    """
    poses, points = block.cam_from_block, block.xyz
    linear = linearise(
        block.cameras, block.camera_of, poses, points, block.point_of, block.photo_of, block.xy
    )
    variance = residual_variance(linear, len(poses), len(points))
    covariances = point_covariances(linear, len(points), variance)
    spread = pose_covariances(linear, len(poses), covariances, variance)
    lengths = np.bincount(block.point_of, minlength=len(points))
    errors = np.bincount(
        block.point_of, weights=np.linalg.norm(linear.residual, axis=1), minlength=len(points)
    ) / np.maximum(lengths, 1)
    epsg = utm_epsg(frame.latitude_deg, frame.longitude_deg)
    return replace(
        feature_map,
        epsg=epsg,
        height_datum=height_datum,
        frame=frame,
        provenance=without_modes(feature_map.provenance),
        cameras=block.cameras,
        images=tuple(
            replace(image, cam_from_local=pose, covariance=covariance)
            for image, pose, covariance in zip(feature_map.images, poses, spread, strict=True)
        ),
        points=replace(
            feature_map.points,
            utm=frame.utm_from_enu(points, epsg),
            error_px=errors.astype(np.float32),
            covariance=upper_triangle(covariances),
        ),
        placement=placement,
        generation=0,
        parents=(),
    )
