"""Step: a placed reconstruction is adjusted to the existing points, and photos that do not hold are left out.

Those contradict the placement before or after, hang on the others by little, or may be further off than
allowed; the others are adjusted without them, and say anew how sure they are.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rotation import so3_log
from featuredb.geometry.sim3 import Sim3
from featuredb.index.area import Area
from ingest.colmap.anchored import Anchored, FixedPoints, Lenses, adjust_anchored, pixel_scale
from ingest.colmap.bridge import Model, with_observations
from ingest.colmap.precision import linearise
from ingest.growth import gates
from ingest.growth.place import drift
from ingest.growth.place.placement import CONTRADICTS, MapsPlacement, edges_of
from ingest.growth.place.similarity_fit import Correspondences, FittedSimilarity, fit_similarity
from ingest.growth.values import TOLERANCE_PX, LocalisedPhoto, Refused
from ingest.photos.photo import Photo
from ingest.sfm.links import bottleneck_share, select_photos

_LOOSE = "DRIFT_BUDGET"  # reason of photos that nothing holds well enough
# `bottleneck_share` that photos need which are not localised themselves. In simulated communities photos tied
# to look-alike halls, 68 and 78 m off, had 0.15 and 0.04; right photos nearly all 0.46 and more, single ones
# 0.14. Those wait, and are localised by themselves once their neighbours are in an active map.
LEAST_LINK = 0.25
_ROUNDS = 4  # of leaving photos out; the others are adjusted without them
# What the focal length of a localisation may be off, one sigma. A photo at the rim of a map sees it in a
# corner, and turns a lens that is 0.5 % off into half a metre and half a degree, where its pixels say 0.1 m.
# `brighton`'s lens is off by 1.3 %.
_FOCAL_REL = 0.01


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refinement:
    """A refined reconstruction.

    Attributes:
        model: of the photos that are kept, in metres, in the placement's frame; existing points that two of
            them see are its own.
        placement: with the gates asked here and the covariances of the refined model.
        spread: of the photos that are kept.
        bending_m: by how much what they show is less sure than the similarity, one sigma, worst axis.
        left_out: photos that are not kept although they agree, by row, with reason and message.
    """

    model: Model
    placement: MapsPlacement
    spread: drift.PhotoSpread
    bending_m: float
    left_out: Mapping[int, tuple[str, str]]


def adopt_lenses(
    model: Model, photos: Sequence[Photo], areas: Sequence[Area], keypoints: Sequence[FloatArray]
) -> tuple[Model, Lenses]:
    """The model adjusted, in its own frame, around the lenses that existing maps have for its cameras.

    Args:
        photos: all, rows as in the model.
        areas: where it may lie; the first one that has a lens for a camera's EXIF key lends it.
        keypoints: pixels of all features of each photo of the model.
    """
    lent: dict[int, Camera] = {}
    focals: dict[int, float] = {}
    for c, camera in enumerate(model.cameras):
        of_camera = [photos[r] for r in model.rows[model.camera_of == c].tolist()]
        keys, told = {photo.camera_key for photo in of_camera}, {photo.focal_px for photo in of_camera}
        key = keys.pop() if len(keys) == 1 else ""
        lens = next((own for area in areas if key and (own := area.camera_for_key(key))), None)
        if lens is not None and (lens.width, lens.height) == (camera.width, camera.height):
            lent[c] = lens
        if len(told) == 1 and (focal_px := told.pop()) is not None:  # none where EXIF tells several
            focals[c] = focal_px
    lenses = Lenses(lent=lent, focal_px=focals)
    if not lent:
        return model, lenses
    given = replace(model, cameras=tuple(lent.get(c, own) for c, own in enumerate(model.cameras)))
    return adjust_anchored(given, keypoints, FixedPoints.none(), lenses).model, lenses


def refine_placed(
    model: Model,
    placement: MapsPlacement,
    localised: Mapping[int, LocalisedPhoto],
    keypoints: Sequence[FloatArray],
    lenses: Lenses,
    max_bound_m: float,
) -> Refinement | Refused:
    """Refine an accepted placement with the existing points held fixed.

    Args:
        localised: the model's photos that the existing maps localise, by place among them.
        keypoints: pixels of all features of each photo of the model.
        max_bound_m: photos that show their places further off (95 %), against the existing points and with
            what their lens leaves open, are left out.
    """
    rows = model.rows.tolist()
    sim = placement.fit.local_from_sfm
    poses = tuple(sim.act_on_pose(pose) for pose in model.cam_from_sfm)
    placed = replace(model, cam_from_sfm=poses, xyz=sim.act(model.xyz))  # in metres
    left_out = dict(placement.left_out)
    left_out |= weak_photos(model, list(left_out), [k for k in placement.agreeing if k not in left_out])
    for _ in range(_ROUNDS):
        good = placement.held.take(~np.isin(placement.held.photo_of, list(left_out)))
        good = good.take(_sigma_px(placed, good) <= TOLERANCE_PX)  # those that hold anything
        adjusted, fixed = _refined(placed, list(left_out), good, lenses, keypoints)
        spread = drift.photo_covariances(adjusted.model, keypoints, fixed, adjusted.fixed_kept, lenses)
        held = good.take(adjusted.fixed_kept)
        fit = fit_similarity(adjusted.model, Sim3.identity(), held)
        inside = {k: localised[k] for k in placement.agreeing if k not in left_out}
        against = contradicting_photos(adjusted.model, inside, spread.poses, (placement.fit, fit))
        loose = loose_photos(spread, max_bound_m)
        loose = {k: why for k, why in loose.items() if k not in left_out and k not in against}
        left_out |= against | loose
        if not (against or loose) or len(left_out) > len(rows) - 2:
            break
    if loose or against:
        what = (
            "hardly a photo is held well enough" if loose else "photos contradict the others again and again"
        )
        reason, message = next(iter((loose or against).values()))
        return Refused(reason=reason, message=f"{what}: {message}", gates=placement.gates)
    edges = edges_of(adjusted.model, fit, held)
    if {e.map_id for e in edges} != {e.map_id for e in placement.edges}:
        edges = placement.edges  # a parent that hardly held: as it was
    whole = _with_existing(adjusted, fixed, good, [e.map_id for e in edges])
    for k in sorted(set(range(len(rows))) - set(left_out) - set(whole.photo_of.tolist())):
        left_out[k] = _LOOSE, "the photo shows nothing that another photo of the map shows as well"
    disagreeing = sum(reason == CONTRADICTS for reason, _ in left_out.values())
    gate = gates.agreement(len(set(placement.agreeing) - set(left_out)), disagreeing)
    if not gate.passes:
        message = f"once refined, {gate.message}"
        return Refused(reason=gate.reason, message=message, gates=placement.gates)
    # Until now the reconstruction was bent as it came, and its residuals said more of that than of where it
    # lies.
    turning = drift.turning_covariance(fit.covariance, spread)
    bending_m2 = float(np.nanmax(np.append(spread.lacks_m2(fit.covariance + turning), 0.0)))
    covariance = fit.covariance + turning + np.diag([0.0] * 4 + [bending_m2] * 3)
    shared = drift.shared_turn(spread)
    edges = tuple(replace(edge, shared=shared) for edge in edges)
    kept = [k for k in range(len(rows)) if k not in left_out]
    return Refinement(
        model=select_photos(whole, [rows[k] for k in kept]),
        placement=replace(placement, edges=edges, covariance=covariance),
        spread=spread.of(kept),
        bending_m=float(np.sqrt(bending_m2)),
        left_out={rows[k]: why for k, why in left_out.items()},
    )


def contradicting_photos(
    model: Model,
    localised: Mapping[int, LocalisedPhoto],
    spread: FloatArray,
    fits: Sequence[FittedSimilarity],
) -> dict[int, tuple[str, str]]:
    """Photos of the model whose own localisation is elsewhere, by their place in it, and why.

    Asked of the refined model: as it comes, one of a few photos is bent by more than localised poses are
    uncertain. The sigmas are those of the localisation, times the spread and the neighbours factor of the
    similarity (poses from the same existing points share their errors), those of the refined pose, and what
    the lens that it was localised with makes where the refined one is another.

    Args:
        localised: by place in the model.
        spread: (k, 6, 6) of `PhotoSpread`; unknown ones (NaN) add nothing.
        fits: of the model to the existing points, as it came and refined.
    """
    limit = gates.sigmas_limit(6)
    dilution = max(max(fit.spread, 1.0) ** 2 * fit.neighbours_factor for fit in fits)
    found: dict[int, tuple[str, str]] = {}
    for k, photo in sorted(localised.items()):
        pose, own_pose = model.cam_from_sfm[k], photo.cam_from_local
        turn = so3_log(own_pose.rotation.T @ pose.rotation)
        offset = np.concatenate([turn, own_pose.center - pose.center])
        into_local = block_diag(pose.rotation.T, pose.rotation.T)
        longer = photo.camera.with_focal((1.0 + _FOCAL_REL) * photo.camera.focal_px)
        refined = model.cameras[int(model.camera_of[k])]
        lenses = sum(np.outer(by, by) for by in (pose_by_lens(photo, lens) for lens in (longer, refined)))
        own = into_local @ (np.nan_to_num(spread[k]) + lenses) @ into_local.T
        square = float(offset @ np.linalg.solve(photo.covariance * dilution + own, offset))
        if square > limit:
            off_m, off_deg = np.linalg.norm(offset[3:]), np.degrees(np.linalg.norm(offset[:3]))
            message = (
                f"the photo by itself is {off_m:.2f} m and {off_deg:.2f} degrees from where the others put "
                f"it, chi-square {square:.0f}, {limit:.0f} is allowed"
            )
            found[k] = CONTRADICTS, message
    return found


def pose_by_lens(photo: LocalisedPhoto, lens: Camera) -> FloatArray:
    """(6,) how far a localised pose is off (left perturbation), if the photo's lens is another one.

    The change of pose that moves the pixels of its points most alike.
    """
    seen = photo.cam_from_local.act(photo.points)
    moved_px = lens.project(seen) - photo.camera.project(seen)
    count = len(photo.pixels)
    if count < 4:
        return np.zeros(6)
    linear = linearise(
        [photo.camera],
        np.zeros(1, dtype=np.int64),
        [photo.cam_from_local],
        photo.points,
        np.arange(count),
        np.zeros(count, dtype=np.int64),
        photo.pixels,
    )
    good = np.isfinite(linear.by_pose).all(axis=(1, 2)) & np.isfinite(moved_px).all(axis=1)
    by_pose = linear.by_pose[good].reshape(-1, 6)
    return np.asarray(np.linalg.lstsq(by_pose, moved_px[good].reshape(-1), rcond=None)[0])


def weak_photos(model: Model, outside: Sequence[int], held: Sequence[int]) -> dict[int, tuple[str, str]]:
    """Photos that hang on those that are held by too little, and why; `outside` do not count."""
    firm = bottleneck_share(model, held, outside)
    needed = f"{100 * LEAST_LINK:.0f} % needed: look-alike places tie photos so"
    tied = "% of its points tie the photo to those that are localised"
    weak = [k for k in np.flatnonzero(firm < LEAST_LINK).tolist() if k not in outside]
    return {k: ("WEAK_LINK", f"{100 * firm[k]:.1f} {tied}, {needed}") for k in weak}


def loose_photos(spread: drift.PhotoSpread, max_bound_m: float) -> dict[int, tuple[str, str]]:
    """Photos that may show their places further off than the bound (95 %) against existing points, and why.

    Those that see nothing any more are loose, unless none was asked.
    """
    bounds = spread.bounds_m()
    if np.isnan(bounds).all():
        return {}
    bounds[np.isnan(bounds)] = np.inf
    loose, allowed = np.flatnonzero(bounds > max_bound_m).tolist(), f"{max_bound_m:.2f} m are allowed"
    return {k: (_LOOSE, f"what the photo shows may be {bounds[k]:.2f} m off, {allowed}") for k in loose}


def _refined(
    model: Model,
    outside: Sequence[int],
    held: Correspondences,
    lenses: Lenses,
    keypoints: Sequence[FloatArray],
) -> tuple[Anchored, FixedPoints]:
    """The model adjusted without the photos `outside`, which stay with poses, existing points held fixed.

    Observations by features that existing points hold are their points' now.
    """
    both = np.stack([held.map_of, held.point_of], axis=1)
    _, first, number = np.unique(both, axis=0, return_index=True, return_inverse=True)
    fixed = FixedPoints(
        xyz=held.points[first], point_of=number.reshape(-1), photo_of=held.photo_of, pixels=held.pixels
    )
    size = int(max(model.keypoint_of.max(initial=0), held.feature.max(initial=0))) + 1
    taken = np.isin(model.photo_of * size + model.keypoint_of, held.photo_of * size + held.feature)
    free = ~np.isin(model.photo_of, outside) & ~taken
    return adjust_anchored(with_observations(model, free), keypoints, fixed, lenses), fixed


def _sigma_px(model: Model, correspondences: Correspondences) -> FloatArray:
    """(m,) largest standard deviation of each existing point across the line of sight, in pixels at 1600."""
    sigma = np.zeros(len(correspondences))
    for k, pose in enumerate(model.cam_from_sfm):
        rows = np.flatnonzero(correspondences.photo_of == k)
        camera = model.cameras[int(model.camera_of[k])]
        toward = correspondences.points[rows] - pose.center
        depth = np.maximum(np.linalg.norm(toward, axis=1), 1e-9)
        ray = toward / depth[:, None]
        across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        spread = np.linalg.eigvalsh(across @ correspondences.covariance[rows] @ across)[:, -1]
        sigma[rows] = camera.focal_px / pixel_scale(camera) * np.sqrt(np.maximum(spread, 0.0)) / depth
    return sigma


def _with_existing(
    adjusted: Anchored, fixed: FixedPoints, correspondences: Correspondences, parents: Sequence[str]
) -> Model:
    """The adjusted model with the existing points that at least two of its photos see as points of its own.

    Args:
        correspondences: (m,) of the observations of `fixed`.
        parents: where a feature is held by points of two maps, the one that comes first here counts.
    """
    rank = np.array([parents.index(m) if m in parents else len(parents) for m in correspondences.map_ids])
    rows = np.flatnonzero(adjusted.fixed_kept)
    order = rows[np.argsort(rank[correspondences.map_of[rows]], kind="stable")]
    feature = np.stack([fixed.photo_of[order], correspondences.feature[order]], axis=1)
    _, first = np.unique(feature, axis=0, return_index=True)
    rows = np.sort(order[first])
    pair = np.unique(np.stack([fixed.point_of[rows], fixed.photo_of[rows]], axis=1), axis=0)
    views = np.bincount(pair[:, 0], minlength=len(fixed.xyz))
    rows = rows[views[fixed.point_of[rows]] >= 2]
    points, point_of = np.unique(fixed.point_of[rows], return_inverse=True)
    model = adjusted.model
    joined = (
        np.concatenate([model.point_of, point_of.reshape(-1) + len(model.xyz)]),
        np.concatenate([model.photo_of, fixed.photo_of[rows]]),
        np.concatenate([model.keypoint_of, correspondences.feature[rows]]),
    )
    by_point = np.lexsort((joined[1], joined[0]))
    return replace(
        model,
        xyz=np.concatenate([model.xyz, fixed.xyz[points]]),
        point_of=joined[0][by_point],
        photo_of=joined[1][by_point],
        keypoint_of=joined[2][by_point],
    )
