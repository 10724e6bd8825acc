"""From reconstructions to feature maps: placed by GPS or control points, or without a place."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, Placement
from featuredb.maps.unplaced_map import NoPlace, UnplacedMap
from ingest.colmap.bridge import Model
from ingest.colmap.picture_shear import IMPOSSIBLE, UNUSUAL, shear_words
from ingest.map_builder import MapIdentity, build_map, build_unplaced_map
from ingest.own_frame import WAYS_TO_A_PLACE, held_of
from ingest.photos.photo import Photo, capture_seconds, gps_priors, local_frame_of, whose_cameras
from ingest.positions.receivers import receivers
from ingest.reconstruction import MapMakingOptions, Reconstructed
from ingest.register.control.maps import Survey, place_by_survey, vertical_of
from ingest.register.control.placement import GcpPlacement
from ingest.register.gps import GpsPlacement, place_by_gps
from ingest.register.tagged_elsewhere import TaggedElsewhere, rightly_joined, tagged_elsewhere
from ingest.sfm.extract import PhotoFeatures
from ingest.sfm.held_lens import impossible
from ingest.sfm.links import keep_photos, select_photos, tied_parts

_WEAKLY_TIED = (
    "fewer than {least} points tie them to any other photo of their reconstruction: buildings that look "
    "alike have as many in common"
)
_ELSEWHERE = (
    "their GPS agrees on a place {offset_m:.0f} m from where their matches put them: they show another place "
    "that looks like it, or their positions have one error"
)
HINTS = "placed by unverified geotags"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Component:
    """One connected component of the photos and what became of it.

    Attributes:
        model: the reconstruction.
        photos: its registered photos, in the order of model.rows.
        with_gps: positions in `photos` of those with GPS; rows of the placement's residuals.
        placement: accepted or refused with a reason.
        feature_map: with a place; None where there is none, for `reason_code` and `reason`.
        unplaced: the map without a place that is kept instead, where there are points for one.
        control: of the placement by control points, where there are some.
    """

    model: Model
    photos: tuple[Photo, ...]
    with_gps: tuple[int, ...]
    placement: GpsPlacement
    feature_map: FeatureMap | None
    unplaced: UnplacedMap | None = None
    reason_code: str = ""
    reason: str = ""
    control: GcpPlacement | None = None

    @property
    def made(self) -> FeatureMap | UnplacedMap | None:
        """The map, with a place or without."""
        return self.unplaced if self.feature_map is None else self.feature_map


def place_models(
    done: Reconstructed,
    options: MapMakingOptions,
    *,
    identity: Callable[[int], MapIdentity],
    survey: Survey | None = None,
) -> Iterator[Component]:
    """Place every model and build its map; one at a time, so that the caller can commit and forget it.

    What hangs on the rest of its model by little is placed by itself; where that is a photo or two, they
    follow as a component without map. So is what look-alikes have joined to it wrongly. Photos whose GPS
    together contradicts that of the others become a map without a place. So does every model whose place
    nothing tells.

    Args:
        identity: of the map of the component with that number.
        survey: control points, which then place the maps instead of GPS.
    """

    def by_gps(model: Model) -> tuple[tuple[int, ...], GpsPlacement]:
        return placed_by_gps(model, [done.usable[r] for r in model.rows])[1:]

    number = itertools.count()
    elsewhere: list[tuple[Model, TaggedElsewhere]] = []
    for whole in done.reconstruction.models():
        loose: list[int] = []
        tied = [select_photos(whole, rows) for rows in tied_parts(whole, options.min_tie)]
        if survey is None:
            tied = [part for one in tied for part in rightly_joined(one, by_gps, options.min_tie)]
        for model in tied:
            rows = model.rows.tolist()
            if len(rows) < options.sfm.min_model_photos:
                loose += rows
                continue
            groups = []
            if survey is None:  # groups of photos whose GPS contradicts a placement that is accepted
                _, with_gps, placed = placed_by_gps(model, [done.usable[r] for r in model.rows])
                groups = tagged_elsewhere(model, with_gps, placed) if placed.reason is None else []
            gone = {int(model.rows[k]) for group in groups for k in group.photos}
            kept = keep_photos(model, set(rows) - gone) if groups else model
            if kept is not None:
                features = done.features.of(kept.rows)
                yield _component(kept, done.usable, features, identity(next(number)), options, survey)
            elsewhere += [(model, group) for group in groups]
        if loose:
            reason = _WEAKLY_TIED.format(least=options.min_tie)
            yield _left_out(select_photos(whole, loose), done.usable, "WEAKLY_TIED", reason)
    for model, group in elsewhere:
        part = select_photos(model, model.rows[list(group.photos)].tolist())
        reason = _ELSEWHERE.format(offset_m=group.offset_m)
        component = _left_out(part, done.usable, "ELSEWHERE", reason)
        if len(part.rows) >= options.sfm.min_model_photos:
            features = done.features.of(part.rows)
            component = _without_place(component, features, identity(next(number)), options)
        yield component


def placed_by_gps(
    model: Model, chosen: Sequence[Photo]
) -> tuple[LocalFrame | None, tuple[int, ...], GpsPlacement]:
    """A model by the GPS of its photos: the frame, photos with GPS by place in the model, the placement."""
    frame = local_frame_of(chosen)  # its own: models may lie in different towns
    positions, sigmas = gps_priors(chosen, frame)
    with_gps = np.flatnonzero(np.isfinite(positions).all(axis=1))
    times_s = capture_seconds([chosen[i] for i in with_gps.tolist()])
    camera_of = _whose_cameras(model, chosen)
    angles, orientations = [photo.angles for photo in chosen], [photo.orientation for photo in chosen]
    held = held_of(model.cam_from_sfm, angles, camera_of, orientations)
    centers, told_by = model.centers()[with_gps], camera_of[with_gps]
    placed = place_by_gps(centers, positions[with_gps], sigmas[with_gps], times_s, held, told_by)
    return frame, tuple(with_gps.tolist()), placed


def _by_gps(model: Model, photos: Sequence[Photo]) -> tuple[Component, LocalFrame | None]:
    """A model as GPS places it or refuses to, without a map yet; and the frame.

    Args:
        photos: all usable ones.
    """
    chosen = tuple(photos[r] for r in model.rows)
    frame, with_gps, placed = placed_by_gps(model, chosen)
    component = Component(
        model=model,
        photos=chosen,
        with_gps=with_gps,
        placement=placed,
        feature_map=None,
        reason_code=placed.reason or "",
        reason=placed.message,
    )
    return component, frame


def _left_out(model: Model, photos: Sequence[Photo], code: str, reason: str) -> Component:
    """Photos that are in no map."""
    return replace(_by_gps(model, photos)[0], reason_code=code, reason=reason)


def _component(
    model: Model,
    photos: Sequence[Photo],
    features: Sequence[PhotoFeatures],
    identity: MapIdentity,
    options: MapMakingOptions,
    survey: Survey | None,
) -> Component:
    """Place one model and build its map; without a place where no placement is accepted.

    Positions that nobody answers for, or that are too few to check a place by, place a quarantined map: it
    answers nothing and places nothing until something better confirms it.

    Args:
        photos: all usable ones.
        features: of the model's.
    """
    component, frame = _by_gps(model, photos)
    chosen, with_gps, placed = component.photos, component.with_gps, component.placement
    if survey is not None:
        return _by_control(component, frame, features, identity, options, survey)
    sim, covariance = placed.local_from_sfm, placed.covariance
    if placed.reason is not None or frame is None or sim is None or covariance is None:
        return _without_place(component, features, identity, options)
    placement = Placement(
        method="gps",
        local_from_sfm=sim,
        covariance=covariance,
        residual_rms_m=placed.residual_rms_m,
        evidence=placement_evidence(placed, [chosen[i] for i in with_gps]),
    )
    hints = [chosen[i].gps_is_hint for i, inner in zip(with_gps, placed.inliers, strict=True) if inner]
    feature_map = build_map(model, placement, frame, chosen, features, identity, options.maps)
    if feature_map is None:
        reason = "no point is placed well enough: the photos' rays are parallel"
        return replace(component, reason_code="NO_POINTS", reason=reason)
    camera_of = _whose_cameras(model, chosen)
    held_back = (
        placed.provisional
        or impossible_lens(model, chosen, float(feature_map.provenance.get("picture_shear", 0.0)))
        or impossible_shear(feature_map, camera_of)
        or (HINTS if any(hints) else "")
    )
    if held_back:
        feature_map = replace(feature_map, status="quarantined")
    return replace(component, feature_map=feature_map, reason_code="", reason=held_back)


def _whose_cameras(model: Model, chosen: Sequence[Photo]) -> NDArray[np.int64]:
    return whose_cameras(chosen, [model.cameras[int(c)].focal_px for c in model.camera_of])


def impossible_lens(model: Model, chosen: Sequence[Photo], shear: float) -> str:
    """Why most of the photos have a focal length that theirs cannot be; "" where they have not.

    Args:
        shear: of the pictures, which a rolling shutter leaves (`ingest.colmap.picture_shear`).
    """
    found = [model.cameras[int(c)].focal_px for c in model.camera_of]
    wrong = np.flatnonzero(impossible(found, [photo.focal_px or np.nan for photo in chosen]))
    if 2 * len(wrong) <= len(chosen):
        return ""
    photo = chosen[int(wrong[0])]
    cause = shear_words(shear) if shear > UNUSUAL else "a zoom, cut pictures, wrong EXIF or a rolling shutter"
    return (
        f"the focal length of {photo.name} became {found[int(wrong[0])]:.0f} px where EXIF says "
        f"{photo.focal_px:.0f}, which fits the photos no better: the map is bent. Likely cause: {cause}"
    )


def impossible_shear(feature_map: FeatureMap, camera_of: NDArray[np.int64]) -> str:
    """That the pictures are sheared as no lens shears them; "" where they are not.

    Nor where many people took them: a camera that moves while it reads out bends a map, and pictures that
    each cut and stretched in his own way do not.

    Args:
        camera_of: (n,) `whose_cameras` of its photos.
    """
    if receivers(camera_of, len(camera_of)) > 1.0:
        return ""
    size = float(feature_map.provenance.get("picture_shear", 0.0))
    return (
        f"{shear_words(size)}: the map is bent more than its positions can tell" if size > IMPOSSIBLE else ""
    )


def _without_place(
    component: Component, features: Sequence[PhotoFeatures], identity: MapIdentity, options: MapMakingOptions
) -> Component:
    """The component with a map in a frame of its own, which says why it has no place."""
    no_place = NoPlace(
        reason_code=component.reason_code,
        reason=component.reason,
        ways=WAYS_TO_A_PLACE,
        evidence=component.placement.figures,
    )
    unplaced = build_unplaced_map(
        component.model, no_place, component.photos, features, identity, options.maps
    )
    return replace(component, unplaced=unplaced)


def _by_control(
    component: Component,
    frame: LocalFrame | None,
    features: Sequence[PhotoFeatures],
    identity: MapIdentity,
    options: MapMakingOptions,
    survey: Survey,
) -> Component:
    """The component placed by control points; GPS, where it was accepted, says what they leave open."""
    block = component.model.block(component.model.pixels([found.features.xy for found in features]))
    block = replace(block, names=tuple(photo.name for photo in component.photos))
    by_gps, vertical = component.placement, None
    if by_gps.reason is None and by_gps.local_from_sfm is not None and by_gps.covariance is not None:
        vertical = vertical_of(by_gps.local_from_sfm, by_gps.covariance, block.xyz, "the photos' GPS")
    positions = [photo.gps for photo in component.photos]
    frame = frame or LocalFrame.amid(survey.file.lat_lon_h)
    placed = place_by_survey(block, positions, frame, vertical, survey)
    component = replace(component, control=placed)
    if placed.reason is not None:
        component = replace(component, reason_code=placed.reason, reason=placed.message)
        return _without_place(component, features, identity, options)
    assert placed.block is not None
    assert placed.local_from_block is not None  # accepted
    adjusted = placed.block.moved(placed.local_from_block.inverse())
    model = replace(
        component.model, cameras=adjusted.cameras, cam_from_sfm=adjusted.cam_from_block, xyz=adjusted.xyz
    )
    datum = placed.height_datum(options.maps.height_datum, options.maps.height_datum)
    feature_map = build_map(
        model,
        placed.map_placement(Sim3.identity()),
        frame,
        component.photos,
        features,
        identity,
        replace(options.maps, height_datum=datum),
    )
    return replace(component, model=model, feature_map=feature_map, reason_code="", reason="")


def placement_evidence(placed: GpsPlacement, photos: Sequence[Photo]) -> dict[str, Any]:
    """What a map keeps of its placement by positions; values that JSON can hold."""
    residuals = {
        photo.name: [round(float(v), 4) if np.isfinite(v) else None for v in row]  # no height: nothing
        for photo, row in zip(photos, placed.residuals_m, strict=True)
    }
    outliers = [photo.name for photo, inner in zip(photos, placed.inliers, strict=True) if not inner]
    return placed.figures | {"residuals_enu_m": residuals, "outlier_photos": outliers}
