"""How far a map may be off at the places that it answers for, and what growth has noted of it."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import point_jacobian, turns_about
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.lineage import GROWTH
from featuredb.maps.place_bounds import NO_HEIGHT_M
from ingest.growth.values import Edge

SIGMAS_95 = 1.96  # 95 % of a normal error along the worst axis


def drift_m(covariance_relative: FloatArray, places: FloatArray) -> float:
    """Bound of 95 % on the position errors of a map against its anchors, metres, at all of the places.

    Args:
        covariance_relative: (7, 7) relative to the anchors. places: (n, 3) in the same frame.
    """
    return SIGMAS_95 * float(place_sigmas_m(covariance_relative, places).max(initial=0.0))


def centers_of(feature_map: FeatureMap) -> FloatArray:
    """(n, 3) centres of a map's photos, in its frame."""
    return np.reshape([image.cam_from_local.center for image in feature_map.images], (-1, 3))


def place_sigmas_m(covariance: FloatArray, places: FloatArray) -> FloatArray:
    """(n,) largest standard deviation of each of the places (n, 3) under a similarity (7, 7), metres."""
    jacobian = point_jacobian(places)
    spread = jacobian @ covariance @ np.swapaxes(jacobian, -1, -2)
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(spread)[:, -1], 0.0)))


def places_of(feature_map: FeatureMap) -> FloatArray:
    """(n, 3) where a map answers for what it says, in its frame: photos and the middle of what each shows.

    Of the points of oblique photos some lie far beyond the scene.
    """
    seen, points = feature_map.observations, feature_map.points_local()
    order = np.argsort(seen.image_id, kind="stable")
    shown = np.split(seen.point_index[order], np.flatnonzero(np.diff(seen.image_id[order])) + 1)
    middles = [np.median(points[rows], axis=0) for rows in shown if len(rows)]
    return np.vstack([centers_of(feature_map), *middles])


def growth_of(evidence: Mapping[str, Any]) -> dict[str, Any]:
    """What growth has written into a placement's evidence; empty for others."""
    return dict(evidence.get(GROWTH) or {})


def with_growth(feature_map: FeatureMap, **figures: Any) -> FeatureMap:
    """The map with these figures in what growth has noted of it, in place of earlier ones."""
    placement = feature_map.placement
    growth = {**growth_of(placement.evidence), **figures}
    return replace(feature_map, placement=replace(placement, evidence={**placement.evidence, GROWTH: growth}))


def with_overlaps(
    feature_map: FeatureMap, covariance_relative: FloatArray, edges: Sequence[Edge], budget_m: float
) -> tuple[FeatureMap, float]:
    """The map with these overlaps and its drift (m), by its covariance (7, 7) to anchors, in its evidence."""
    drift = drift_m(covariance_relative, places_of(feature_map))
    noted = with_growth(
        feature_map,
        drift_m=round(drift, 6),
        budget_m=budget_m,
        covariance_relative=covariance_relative.ravel().tolist(),
        edges=[edge.as_json() for edge in edges],
    )
    return noted, drift


def inflated(feature_map: FeatureMap) -> FeatureMap:
    """The map with its placement's covariance `isotropic_inflation`."""
    alike = isotropic_inflation(feature_map, feature_map.placement.covariance)
    return replace(feature_map, placement=replace(feature_map.placement, covariance=alike))


def isotropic_inflation(feature_map: FeatureMap, covariance: FloatArray) -> FloatArray:
    """(7, 7) that turns and shifts the map in all directions as much as the given one in its worst.

    About the middle of its photos; not less, anywhere that the map answers for, than the given one says for
    the worst direction there. A height that nobody knows is no such direction. The covariance is of the
    placement's left perturbation, in the map's frame.
    """
    middle = centers_of(feature_map).mean(axis=0)
    unknown_m2 = float(covariance[6, 6])
    if unknown_m2 > NO_HEIGHT_M**2:
        about_middle = np.vstack([np.eye(4, 7), point_jacobian(middle)])
        covariance = about_middle @ covariance @ about_middle.T
        covariance[6], covariance[:, 6] = 0.0, 0.0
        covariance[6, 6] = covariance[4:6, 4:6].diagonal().max()
        back = np.linalg.inv(about_middle)
        alike = isotropic_inflation(feature_map, back @ covariance @ back.T)
        return alike + np.diag([0.0] * 6 + [unknown_m2])
    shift_m2 = float(place_sigmas_m(covariance, middle[None])[0]) ** 2
    turn = float(np.linalg.eigvalsh(covariance[1:4, 1:4])[-1])
    about = turns_about(middle)
    grow = np.concatenate([[1.0, 0.0, 0.0, 0.0], -middle])[:, None]
    alike = covariance[0, 0] * grow @ grow.T + turn * about @ about.T
    alike += np.diag([0.0] * 4 + [shift_m2] * 3)
    places = places_of(feature_map)
    ratio = place_sigmas_m(covariance, places) / place_sigmas_m(alike, places)
    return np.asarray(max(1.0, float(ratio.max())) ** 2 * alike)
