"""Gates on an anchored map as a whole: does it lie on the scan, and may it be where it goes?"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from featuredb.maps.feature_map import FeatureMap
from featuredb.render.cloud import PointCloud
from ingest.register.anchor.values import AnchorOptions, AnchorResult
from ingest.register.structure.map_move import (
    MapMove,
    map_move,
    map_residuals,
    viewing_distance_m,
)


def judged(
    old: FeatureMap,
    new: FeatureMap,
    cloud: PointCloud,
    found: AnchorResult,
    options: AnchorOptions,
    *,
    supervised: bool,
) -> AnchorResult:
    """The gates on the placed map as a whole."""
    before, after = map_residuals(old, new, cloud)
    move = map_move(old, new)
    distance = viewing_distance_m(new)
    apart = found.agreement.apart_m if found.agreement else {}
    allowed = found.agreement.allowed_m if found.agreement else {}
    checks: dict[str, Any] = {
        "before": before.as_figures(),
        "after": after.as_figures(),
        "move": move.as_figures(),
        "viewing_distance_m": distance,
        "frames_apart_m": [
            {"frames": list(pair), "apart_m": metres, "allowed_m": allowed[pair]}
            for pair, metres in apart.items()
        ],
    }
    found = replace(found, before=before, after=after, checks=checks, message="")
    if not len(after.distance_m) or after.median_m > max(options.max_residual_share * distance, 0.05):
        return replace(
            found,
            reason="NOT_BETTER",
            message=f"the map's points would lie {after.median_m:.2f} m (median) from the scan, "
            f"{max(options.max_residual_share * distance, 0.05):.2f} m allowed",
        )
    if after.median_m > max(before.median_m, 0.05):
        return replace(
            found,
            reason="NOT_BETTER",
            message=f"the map's points lie {before.median_m:.2f} m (median) from the scan now and would lie "
            f"{after.median_m:.2f} m from it",
        )
    words = None if supervised else _contradiction(move, options)
    if words is not None:
        return replace(found, reason="CONTRADICTS_PLACEMENT", message=words)
    evidence = new.placement.evidence | {
        "anchor": checks
        | {
            "frames": _names(old, found.used),
            "rounds": [
                {"focal_px": list(r.focal_px), "structure_s": r.structure_s, "adjust_s": r.adjust_s}
                for r in found.rounds
            ],
            "supervised": supervised,
        }
    }
    placement = replace(new.placement, evidence=evidence)
    placed = replace(new, placement=placement, generation=0, parents=(), status="active")
    return replace(found, reason=None, feature_map=placed)


def _contradiction(move: MapMove, options: AnchorOptions) -> str | None:
    """Why the map cannot be there by its placement, or None. Heights are not judged, see AnchorOptions."""
    far = options.max_placement_sigmas
    if move.horizontal_m > options.min_move_m and move.horizontal_sigmas > far:
        what = f"move by {move.horizontal_m:.1f} m in plan, {move.horizontal_sigmas:.1f} sigmas"
    elif abs(move.heading_deg) > options.min_turn_deg and move.heading_sigmas > far:
        what = f"turn by {move.heading_deg:.1f} degrees, {move.heading_sigmas:.1f} sigmas"
    elif move.tilt_deg > options.min_turn_deg and move.tilt_sigmas > far:
        what = f"tilt by {move.tilt_deg:.1f} degrees, {move.tilt_sigmas:.1f} sigmas"
    elif abs(move.scale - 1.0) > options.max_scale_change and move.scale_sigmas > far:
        what = f"change its scale by {100 * (move.scale - 1.0):+.1f} %, {move.scale_sigmas:.1f} sigmas"
    else:
        return None
    return (
        f"the map would {what} of its present placement, {far:.0f} allowed; if that placement is known to be "
        "wrong, confirm the frames (--confirm)"
    )


def _names(feature_map: FeatureMap, ids: Sequence[int]) -> list[str]:
    return [image.name for image in feature_map.images if image.image_id in ids]
