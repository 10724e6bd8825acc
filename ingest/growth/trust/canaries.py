"""Canaries: photos whose right answer is known are asked before and after a map would be promoted.

A regression is a canary that was answered rightly and no longer is, or a photo of elsewhere that now finds a
place. Beside those of the database, images of the active maps serve, by their observations: for answers that
the new map takes away, makes ambiguous or pulls along, or has somewhere else.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import matrix_from_quaternion
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.plain_json import plain
from featuredb.store import Database
from featuredb.store.canaries import TOLERANCE_DEG, Canary, KnownPose, list_canaries, load_canary_image
from ingest.growth.gates import SIGMAS, Gate, agreement
from ingest.growth.place.map_images import LEAST_FEATURES, NEAR_M, features_and_points
from ingest.growth.values import DRIFT_BUDGET_M
from reloc.localise.acceptance import AcceptanceOptions
from reloc.localise.localise import localise_features
from reloc.localise.options import LocaliseOptions
from reloc.localise.result import LocalisedPose, LocaliseRequest, LocaliseResult
from reloc.localiser import Localiser
from reloc.service.handler import decode_photo, localise_request
from reloc.wire.query import LocaliseWireRequest

# What a map keeps of its images shows its own points alone: that an image does not show what a new map adds
# around them says nothing against either.
_OWN_FEATURES = LocaliseOptions(acceptance=AcceptanceOptions(min_spread=0.0, min_agreement=0.0))
_EXTRACTOR = _OWN_FEATURES.extractor.fingerprint  # no query finds anything in maps of another one

Verdict = Literal["right", "lost", "moved", "found", "not_found"]

_OWN_NEAR = 8  # images of active maps that are asked around the new one, and half as many elsewhere


@dataclass(frozen=True, slots=True, kw_only=True)
class CanaryCheck:
    """One canary.

    Attributes:
        before, after: verdict on the answers. alone: on that of the new maps without the others, if asked.
        error_before_m, error_m: of the answers; NaN where there is none.
    """

    name: str
    before: Verdict
    after: Verdict
    alone: Verdict = "lost"
    error_before_m: float = float("nan")
    error_m: float = float("nan")
    regression: str = ""

    def as_json(self) -> dict[str, Any]:
        told = {name: getattr(self, name) for name in ("name", "before", "after", "regression")}
        return {**told, "error_m": plain(round(self.error_m, 4))}


@dataclass(frozen=True, slots=True, kw_only=True)
class CanaryRun:
    """All canaries; `note` says where they come from."""

    checks: tuple[CanaryCheck, ...]
    note: str

    @property
    def regressions(self) -> tuple[CanaryCheck, ...]:
        return tuple(check for check in self.checks if check.regression)

    @property
    def gate(self) -> Gate:
        """Whether no known answer got worse."""
        count = len(self.regressions)
        message = f"{len(self.checks)} canaries answered as before ({self.note})"
        if count:
            first = self.regressions[0]
            message = f"{count} of {len(self.checks)} canaries regress: {first.name}: {first.regression}"
        return Gate.at_most("canaries", "CANARY", count, 0, message)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Miss:
    metres: float
    degrees: float
    sigma_m: float

    def __str__(self) -> str:
        return f"{self.metres:.2f} m and {self.degrees:.2f} degrees"


def run_canaries(
    database: Database, before: Localiser, after: Localiser, new_maps: Sequence[FeatureMap]
) -> CanaryRun:
    """Ask all known queries and images of the maps, before and after.

    Args:
        before: the active maps. after: the same with the new ones, which are asked alone, too.

    Raises:
        StoreError, CanaryNotFoundError: a canary's image cannot be read.
    """
    known = list_canaries(database)
    checks = [check_known(database, canary, before, after) for canary in known]
    own, new_ids = own_canaries(database, before, new_maps), tuple(m.map_id for m in new_maps)
    asked = [_check_own(feature_map, image, before, after, new_ids) for feature_map, image in own]
    alone = Counter(check.alone for check, _ in asked)
    # As of photos that are localised by themselves: a few may be taken in by another place that looks alike.
    agree = agreement(alone["right"], alone["moved"]).passes
    for check, elsewhere in asked:
        checks.append(check if agree or check.regression else replace(check, regression=elsewhere))
    note = f"{len(known)} known queries, {len(own)} images of the active maps"
    if not known:
        note += "; the database has no known queries, `featuredb canary add` adds them"
    others = [a.area for a in before.areas if a.area.extractor_fingerprint != _EXTRACTOR]
    if others:
        note += f"; {sum(len(area.maps) for area in others)} maps of another extractor are not asked"
    return CanaryRun(checks=tuple(checks), note=note)


def check_known(database: Database, canary: Canary, before: Localiser, after: Localiser) -> CanaryCheck:
    """Ask one known query of both."""
    data = load_canary_image(database, canary)
    gray, header = decode_photo(data, after)
    asked = LocaliseWireRequest.model_validate_json(json.dumps(dict(canary.request)))
    request = localise_request(asked, data, header)
    results = [localiser.localise(gray, request, header.size) for localiser in (before, after)]
    known = canary.pose
    if known is None:
        verdicts: list[Verdict] = ["not_found" if r.pose is None else "found" for r in results]
        return _checked(canary.name, verdicts, (None, None), results[1])
    easting, northing, height = known.utm.tolist()
    frame = LocalFrame.from_utm(easting, northing, height, known.epsg)
    rotation = matrix_from_quaternion(known.cam_from_utm_xyzw) @ frame.grid_from_enu(np.zeros(3), known.epsg)
    there = Rigid3(rotation=rotation, translation=np.zeros(3))
    misses = [_miss(result.pose, frame, there) for result in results]
    verdicts = [_verdict(miss, known.tolerance_m, known.tolerance_deg) for miss in misses]
    return _checked(canary.name, verdicts, misses, results[1])


def answer_now(database: Database, image: bytes) -> tuple[KnownPose | None, int]:
    """What the active maps answer to a photo, as what is known of it; None where they do not localise it.

    Raises:
        ImageError: no usable image.
    """
    localiser = Localiser.open(database)
    gray, header = decode_photo(image, localiser)
    pose = localiser.localise(gray, localise_request(LocaliseWireRequest(), image, header), header.size).pose
    if pose is None:
        return None, localiser.snapshot
    known = KnownPose(
        epsg=pose.epsg, utm=pose.utm, height_datum=pose.height_datum, cam_from_utm_xyzw=pose.cam_from_utm_xyzw
    )
    return known, localiser.snapshot


def _verdict(miss: _Miss | None, metres: float, degrees: float) -> Verdict:
    """What an answer is worth that should be no further off than that."""
    if miss is None:
        return "lost"
    return "right" if miss.metres <= metres and miss.degrees <= degrees else "moved"


def own_canaries(
    database: Database, before: Localiser, new_maps: Sequence[FeatureMap]
) -> list[tuple[FeatureMap, MapImage]]:
    """Images of the active maps that can be asked: those around the new maps, some from elsewhere.

    The choice hangs on the images' names only, so that another run asks the same.
    """
    near: list[tuple[str, str, MapImage]] = []
    far: list[tuple[str, str, MapImage]] = []
    boxes = []  # in plan, (2, 2), of the maps' points without the few wild ones, with a margin
    for m in new_maps:
        if len(m.points):
            low, high = np.percentile(m.points_local()[:, :2], (2, 98), axis=0)
            boxes.append((m.frame, low - NEAR_M, high + NEAR_M))
    snapshot = database.snapshot(before.snapshot)
    for indexed in before.areas:
        if indexed.area.extractor_fingerprint != _EXTRACTOR:
            continue
        own = snapshot.images_of([m.map_id for m in indexed.area.maps])
        images = [(m, image) for m in indexed.area.maps for image in own[m.map_id]]
        for (feature_map, image), described in zip(images, indexed.area.image_sights, strict=True):
            if described < LEAST_FEATURES:
                continue
            key = hashlib.sha256(f"{feature_map.map_id} {image.name}".encode()).hexdigest()
            around = False
            for frame, low, high in boxes:
                there = frame.enu_from(feature_map.frame).act(image.cam_from_local.center)[:2]
                around |= bool(((there >= low) & (there <= high)).all())
            (near if around else far).append((key, feature_map.map_id, image))
    near.sort(key=lambda e: e[0])
    far.sort(key=lambda e: e[0])
    load = cache(snapshot.load_map)
    return [(load(map_id), image) for _, map_id, image in near[:_OWN_NEAR] + far[: _OWN_NEAR // 2]]


def _check_own(
    feature_map: FeatureMap, image: MapImage, before: Localiser, after: Localiser, new_ids: tuple[str, ...]
) -> tuple[CanaryCheck, str]:
    """Ask an image of a map of both, and of the new maps alone; and where these have it, if elsewhere.

    An answer may miss by the drift budget, one by the new maps alone by `SIGMAS` of its own, if that is more.
    """
    features, _ = features_and_points(feature_map, image)
    request = LocaliseRequest(camera=feature_map.cameras[image.camera_id])
    results = []
    for localiser, map_ids in ((before, None), (after, None), (after, new_ids)):
        areas = localiser.areas_of(map_ids)
        areas = [a for a in areas if a.area.extractor_fingerprint == features.fingerprint]
        results.append(localise_features(features, request, areas, _OWN_FEATURES).result)
    misses = [_miss(result.pose, feature_map.frame, image.cam_from_local) for result in results]
    verdicts = [_verdict(miss, DRIFT_BUDGET_M, TOLERANCE_DEG) for miss in misses[:2]]
    may_miss_m = SIGMAS * misses[2].sigma_m if misses[2] else 0.0
    alone = _verdict(misses[2], max(DRIFT_BUDGET_M, may_miss_m), TOLERANCE_DEG)
    check = _checked(f"{image.name} of map {feature_map.map_id}", verdicts, misses, results[1])
    elsewhere = f"the new map alone has it {misses[2]} from where it is" if alone == "moved" else ""
    return replace(check, alone=alone), elsewhere


def _checked(
    name: str, verdicts: Sequence[Verdict], misses: Sequence[_Miss | None], result: LocaliseResult
) -> CanaryCheck:
    """What became of an answer: verdicts and misses before and after, and the result after."""
    (before, after), regression = verdicts, ""
    was_m, is_m = (float("nan") if miss is None else miss.metres for miss in misses[:2])
    if before in ("right", "not_found") and after not in ("right", "not_found"):
        regression = f"now {misses[1]} off"
        if after == "found":
            regression = "a photo of elsewhere now finds a place"
        elif misses[1] is None:
            regression = f"no longer localised: {result.reason}: {result.detail}"
    return CanaryCheck(
        name=name, before=before, after=after, regression=regression, error_before_m=was_m, error_m=is_m
    )


def _miss(pose: LocalisedPose | None, frame: LocalFrame, cam_from_local: Rigid3) -> _Miss | None:
    """How far an answer is from a known pose in a local frame."""
    if pose is None:
        return None
    expected = cam_from_local @ frame.enu_from(pose.frame)
    return _Miss(
        metres=float(np.linalg.norm(pose.cam_from_local.center - expected.center)),
        degrees=pose.cam_from_local.angle_to_deg(expected),
        sigma_m=float(np.sqrt(np.linalg.eigvalsh(pose.covariance[3:, 3:])[-1])),
    )
