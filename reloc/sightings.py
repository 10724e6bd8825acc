"""What a localised photo says about the map's points: which it should show, and which of them it found."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from featuredb.features.features import Features
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.index.area import Area
from featuredb.maps.ageing import Sighting
from reloc.localise import Localised
from reloc.matching import guided_matches, visible_points
from reloc.options import MatchOptions, PoseOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class SightingOptions:
    """When a photo should show a point. Strict: an unfair expectation ages a good point.

    Attributes:
        beyond_views_deg: how far outside the cone of the map's own views a photo may stand. Within it the
            map's cameras saw the point, so no wall is in the way.
        max_scale: how much nearer or farther than those cameras.
        rim_share: share of the width at the photo's rim that is left out: a descriptor needs surroundings.
        matching, pose: as in localisation.
    """

    beyond_views_deg: float = 3.0
    max_scale: float = 1.3
    rim_share: float = 0.03
    matching: MatchOptions = field(default_factory=MatchOptions)
    pose: PoseOptions = field(default_factory=PoseOptions)


def sightings_of(
    localised: Localised,
    features: Features,
    source: str,
    write_ids: Mapping[str, str],
    options: SightingOptions | None = None,
) -> list[Sighting]:
    """One sighting for each map that the photo should show; none where it was not localised.

    Args:
        features: of the photo, all of them.
        source: who took the photo, on which day, with which camera.
        write_ids: state of each map of the area, by map id.
    """
    options = options or SightingOptions()
    best = localised.best
    if best is None:
        return []
    area, pose = best.area, best.pose
    expected = expected_points(area, pose.camera, pose.cam_from_local, options)
    matches = guided_matches(
        features, area, expected.astype(np.int32), pose.camera, pose.cam_from_local, options.matching
    )
    error = np.linalg.norm(
        pose.camera.project(pose.cam_from_local.act(area.points[matches.point]))
        - features.xy[matches.feature],
        axis=1,
    )
    side = max(pose.camera.width, pose.camera.height)
    seen = matches.point[error < options.pose.tolerance_rel * side]
    found = []
    for number in np.unique(area.point_map[expected]):
        map_id = area.maps[number].map_id
        mine = [area.point_row[rows[area.point_map[rows] == number]] for rows in (expected, seen)]
        found.append(
            Sighting(map_id=map_id, write_id=write_ids[map_id], source=source, expected=mine[0], seen=mine[1])
        )
    return found


def expected_points(
    area: Area, camera: Camera, cam_from_local: Rigid3, options: SightingOptions
) -> NDArray[np.int64]:
    """Rows of the area's points that a photo from there should show."""
    rows = visible_points(area, np.arange(len(area.points)), camera, cam_from_local)
    offset = cam_from_local.center - area.points[rows]
    distance = np.linalg.norm(offset, axis=1)
    cosine = np.einsum("ij,ij->i", offset, area.view_direction[rows]) / np.maximum(distance, 1e-9)
    cone = np.arccos(np.clip(area.view_spread_cos[rows], -1.0, 1.0)) + np.radians(options.beyond_views_deg)
    near, far = area.view_distance[rows].T
    pixels = camera.project(cam_from_local.act(area.points[rows]))
    rim = options.rim_share * camera.width
    inside = (np.minimum(pixels, [camera.width, camera.height] - pixels) > rim).all(axis=1)
    usual = (distance > near / options.max_scale) & (distance < far * options.max_scale)
    fair = (np.arccos(np.clip(cosine, -1.0, 1.0)) <= cone) & usual & inside
    return np.asarray(rows[fair], dtype=np.int64)
