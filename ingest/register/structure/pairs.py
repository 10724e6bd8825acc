"""3D/3D pairs: points of a map, projected through a registered frame onto the scan."""

from collections.abc import Mapping
from dataclasses import fields

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import skew
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.maps.move import full_covariances
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import RenderOptions, render
from ingest.register.frame_registration import FrameRegistration
from ingest.register.structure.depth_filter import SurfaceHits, surface_at
from ingest.register.structure.similarity import Pairs

# Of the depth image; about the resolution at which airborne scans have a point in most pixels of a drone's
# photo. Hits come from keypoints and scan points, whatever the resolution: of 1000 px, the image takes two to
# three times as long, and maps lie within a fifth of their sigmas of where they do now.
_RENDER_WIDTH_PX = 600
# Standard deviation of a keypoint against the scan, as a share of the photo's longer side: a pixel in 2000,
# what lens models leave.
_PIXEL_SIGMA_REL = 0.0005
_SCAN_SIGMA_M = 0.03  # of the scan's points across their surface, beyond what the roughness shows
_MAX_POINT_SIGMA_REL = 0.05  # map points less certain than this share of their distance are left out
_CELLS = 6  # per side of the grid of neighbourhoods in a frame

Registered = Mapping[int, FrameRegistration]  # accepted, in the local frame of the cloud, by image id


def structure_pairs(
    feature_map: FeatureMap, source: FloatArray, registered: Registered, cloud: PointCloud
) -> Pairs:
    """Pairs of all frames.

    Args:
        source: (n, 3) the map's points in the cloud's local frame, at their present place.
    """
    images = {image.image_id: image for image in feature_map.images}
    uncertainty = full_covariances(feature_map.points.covariance)
    parts = [
        _pairs_of_frame(feature_map, source, uncertainty, images[image_id], registration, row, cloud)
        for row, (image_id, registration) in enumerate(registered.items())
    ]
    return Pairs(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Pairs)})


def _pairs_of_frame(
    feature_map: FeatureMap,
    source: FloatArray,
    uncertainty: FloatArray,
    image: MapImage,
    registration: FrameRegistration,
    row: int,
    cloud: PointCloud,
) -> Pairs:
    pose, covariance, camera = registration.cam_from_local, registration.covariance, registration.camera
    assert pose is not None
    assert covariance is not None
    assert camera is not None  # accepted
    width = min(_RENDER_WIDTH_PX, camera.width)
    small = camera.scaled_to(width, round(camera.height * width / camera.width))
    rendering = render(cloud, small, pose, RenderOptions(threads=1, attributes=False))
    observations = feature_map.observations
    mine = observations.image_id == image.image_id
    pixels = observations.xy[mine].astype(np.float64) * (
        small.width / camera.width,
        small.height / camera.height,
    )
    hits = surface_at(rendering, cloud, pixels)
    points = observations.point_index[mine][hits.rows]
    largest = np.linalg.eigvalsh(uncertainty[points])[:, -1]
    own, by_frame = _errors(hits, pose, camera)
    at = pixels[hits.rows] / (small.width, small.height)
    grid = np.minimum((at * _CELLS).astype(np.int64), _CELLS - 1)
    pairs = Pairs(
        frame_of=np.full(len(points), row, dtype=np.int64),
        source=source[points],
        target=hits.points,
        covariance=own + uncertainty[points],
        by_frame=by_frame,
        cell_of=row * _CELLS**2 + grid[:, 1] * _CELLS + grid[:, 0],
        frame_covariance=covariance[None],
    )
    distance = np.linalg.norm(hits.points - pose.center, axis=1)
    return pairs.of(largest <= (_MAX_POINT_SIGMA_REL * distance) ** 2)


def _errors(hits: SurfaceHits, pose: Rigid3, camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Covariance (n, 3, 3) of each hit by its own errors, and derivative (n, 3, 6) by the frame's pose.

    A ray that turns or shifts by d meets the surface's plane at d - u (n.d)/(n.u), u being its direction.
    """
    rays = hits.points - pose.center
    direction = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    facing = np.einsum("ij,ij->i", hits.normals, direction)
    slide = np.eye(3) - direction[:, :, None] * hits.normals[:, None, :] / facing[:, None, None]
    pixel_m = _PIXEL_SIGMA_REL * max(camera.width, camera.height) / camera.focal_px * hits.depths
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    shifted = slide @ across
    own = (pixel_m**2)[:, None, None] * shifted @ np.swapaxes(shifted, 1, 2)
    along = hits.sigma_ray_m**2 + (_SCAN_SIGMA_M / facing) ** 2
    own += along[:, None, None] * direction[:, :, None] * direction[:, None, :]
    # T_true = exp(xi) T moves the point at camera coordinates p by -R' (omega x p + nu).
    in_camera = pose.act(hits.points)
    by_pose = np.concatenate([skew(in_camera), np.broadcast_to(-np.eye(3), (len(rays), 3, 3))], axis=2)
    return own, slide @ (pose.rotation.T @ by_pose)
