"""Step: a reconstruction without a place of its own is placed by the existing maps, or refused.

Photos localise by themselves; the similarity that most of them agree with is fitted to all pixels in which
they see existing points; then gates ask whether to believe it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3, point_jacobian
from featuredb.geometry.view_cones import in_view, view_cones
from featuredb.index.area import Area
from featuredb.maps.move import covariance_in_frame
from ingest.colmap.bridge import Model
from ingest.growth import gates
from ingest.growth.gates import Gate
from ingest.growth.map_places import growth_of
from ingest.growth.place.similarity_fit import (
    Correspondences,
    FittedSimilarity,
    agreed_similarity,
    fit_similarity,
)
from ingest.growth.values import LEAST_PHOTOS, LEAST_SHARED_POINTS, Edge, LocalisedPhoto, Refused
from ingest.photos.photo import Photo
from reloc.localise.acceptance import agreement
from reloc.localise.matching import EXPECTED_DEG, visible_points

# Least share of the parts that should show points of existing maps or of the photo's own reconstruction. A
# re-upload 13.3 m off showed 0.17; right photos of that database 0.32 and more, of the one that grew with
# this limit 0.23 and more.
_LEAST_SHOWN = 0.25
CONTRADICTS = "CONTRADICTS"  # reason of photos that their own localisation has elsewhere
_SHOWS_LITTLE = "the photo shows too little of what existing maps say it should show from where it would be"
_ELSEWHERE = "the photo by itself sees existing points elsewhere than the others put it"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapsPlacement:
    """A reconstruction that existing maps place, to be believed where all gates pass.

    Attributes:
        frame: local frame in which `fit` places the model.
        covariance: (7, 7) of the similarity's left perturbation, relative to the existing maps.
        agreeing: localised photos that agree with the placement, by their place in the model.
        left_out: reason and message of those that do not, and of any that show too little of what existing
            maps, or the others' points, say they should.
        edges: one for each existing map that holds it, most shared points first: the correction that this
            map alone would apply to the placed one.
        fit: over the correspondences that agree, `held`.
        residual_rms_m: of the agreeing photos' centres, placed minus localised, metres.
        gates: every gate with its figure, in the order they were asked.
    """

    frame: LocalFrame
    covariance: FloatArray
    agreeing: tuple[int, ...]
    left_out: Mapping[int, tuple[str, str]]
    edges: tuple[Edge, ...]
    fit: FittedSimilarity
    held: Correspondences
    residual_rms_m: float
    gates: tuple[Gate, ...]


def place_by_maps(
    model: Model,
    own: Mapping[int, LocalisedPhoto],
    keypoints: Sequence[FloatArray],
    photos: Sequence[Photo],
    areas: Sequence[Area],
    frame: LocalFrame,
) -> MapsPlacement | Refused:
    """Place a model by the localisations of its photos; refused where no map holds it.

    Args:
        model: with the lenses that it keeps.
        own: the model's localised photos, by place among them, in `frame`.
        keypoints: pixels of all features of each photo of the model.
        photos: all new photos, for their positions.
        areas: that hold the existing maps.
    """
    found = agreed_similarity(model, own, keypoints, ())
    edges = edges_of(model, found[0], found[2]) if found else ()
    if not found or not edges:
        gate = gates.agreement(0, len(own))
        return replace(Refused.by(gate), message=f"no placement: {gate.message}")
    fit, agree, held = found
    on_earth, sim = parents_covariance(edges, areas, frame), fit.local_from_sfm
    existing, with_own = _shown_parts(model, sim, held, areas, frame)
    left_out = dict.fromkeys(sorted(own.keys() - agree), (CONTRADICTS, _ELSEWHERE))
    blind = {*np.flatnonzero(with_own < _LEAST_SHOWN).tolist()} - left_out.keys()
    blind |= {k for k in agree if existing[k] < gates.LEAST_VISIBLE}
    left_out |= dict.fromkeys(sorted(blind), ("NOT_VISIBLE", _SHOWS_LITTLE))
    centers = sim.act(model.centers())
    squared_m2 = [((own[k].cam_from_local.center - centers[k]) ** 2).sum() for k in agree]
    positions = _against_positions(model, centers, photos, frame, fit.covariance + on_earth)
    return MapsPlacement(
        frame=frame,
        covariance=fit.covariance,
        agreeing=tuple(sorted(agree)),
        left_out=left_out,
        edges=edges,
        fit=fit,
        held=held,
        residual_rms_m=float(np.sqrt(np.mean(squared_m2))),
        gates=(
            gates.agreement(len(agree), len(own) - len(agree)),
            gates.geotags(*positions, by=", ".join(e.map_id for e in edges)),
            gates.visibility(existing[np.isfinite(existing)]),
        ),
    )


def _against_positions(
    model: Model, centers: FloatArray, photos: Sequence[Photo], frame: LocalFrame, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Horizontal offsets (n, 2) of the placed centres from the photos' positions, covariances (n, 2, 2).

    Heights of photos are rarely in a known datum.
    """
    offsets, spreads = [], []
    for center, row in zip(centers, model.rows.tolist(), strict=True):
        gps = photos[row].gps
        if gps is None:
            continue
        height = float(frame.geodetic_from_enu(center)[2])
        place = frame.enu_from_geodetic([gps.latitude_deg, gps.longitude_deg, height])
        jacobian = point_jacobian(center)[:2]
        offsets.append((center - place)[:2])
        spreads.append(jacobian @ covariance @ jacobian.T + np.eye(2) * gps.sigma_horizontal_m**2)
    return np.array(offsets).reshape(-1, 2), np.array(spreads).reshape(-1, 2, 2)


def edges_of(model: Model, fit: FittedSimilarity, held: Correspondences) -> tuple[Edge, ...]:
    """How each existing map holds the model, by its own points alone where they suffice."""
    found: list[Edge] = []
    for m, map_id in enumerate(held.map_ids):
        mine = held.take(held.map_of == m)
        points, photos = len(np.unique(mine.point_of)), len(np.unique(mine.photo_of))
        if points < LEAST_SHARED_POINTS or photos < gates.LEAST_AGREEING:
            continue
        alone = fit_similarity(model, fit.local_from_sfm, mine)
        edge = Edge(
            map_id=map_id,
            other_from_map=alone.local_from_sfm @ fit.local_from_sfm.inverse(),
            covariance=alone.covariance,
            shared_points=points,
            photos=photos,
        )
        found.append(edge)
    return tuple(sorted(found, key=lambda e: (-e.shared_points, e.map_id)))


def parents_covariance(
    edges: Sequence[Edge], areas: Sequence[Area], frame: LocalFrame, *, relative: bool = False
) -> FloatArray:
    """(7, 7) of the placements of the edges' maps in `frame`, weighted by the shared points.

    The mean of covariances bounds that of a mean from above however the parents' errors are correlated.

    Args:
        areas: that hold these maps.
        relative: to their anchors, nothing for anchors; else on Earth.
    """
    maps, covariance = {m.map_id: m for area in areas for m in area.maps}, np.zeros((7, 7))
    for edge in edges:
        parent = maps[edge.map_id]
        own = parent.placement.covariance
        if relative:
            told = growth_of(parent.placement.evidence).get("covariance_relative", np.zeros(49))
            own = np.reshape(told, (7, 7))
        covariance += edge.shared_points * covariance_in_frame(own, parent.frame, frame)
    return covariance / sum(edge.shared_points for edge in edges)


def _shown_parts(
    model: Model, sim: Sim3, held: Correspondences, areas: Sequence[Area], frame: LocalFrame
) -> tuple[FloatArray, FloatArray]:
    """For each photo the share of the image's parts that should show points where it does so.

    Photos that no map localised are asked as well: a camera that looks through a wall, and a copy that was
    joined at a look-alike, fit what they see and do not show the rest.

    Args:
        sim: frame from the model's.
        held: pixels of the model's photos in which existing points are seen, where the placement has them.

    Returns:
        Shares (k,) of the points of existing maps, and (k,) of these and of the points of the model itself
        that several photos bear out; NaN for photos that should show hardly any.
    """
    often = model.track_lengths() >= LEAST_PHOTOS
    cones = view_cones(model.xyz, model.centers(), model.point_of, model.photo_of)
    shares = np.full((2, len(model.rows)), np.nan)
    for k, pose in enumerate(model.cam_from_sfm):
        camera = model.cameras[int(model.camera_of[k])]
        expected, seen = [np.zeros((0, 2))], [held.pixels[held.photo_of == k]]
        for area in areas:
            in_area = sim.act_on_pose(pose) @ frame.enu_from(area.frame)
            rows = visible_points(area, area.searched_points(), camera, in_area)
            expected.append(camera.project(in_area.act(area.points[rows])))
        own = often & in_view(model.xyz, cones, camera, pose, EXPECTED_DEG)
        seen_own = model.point_of[(model.photo_of == k) & often[model.point_of]]
        for row in range(2):
            should = np.concatenate(expected)
            if len(should) >= LEAST_SHARED_POINTS:
                shares[row, k] = agreement(np.concatenate(seen), should, camera.width, camera.height)
            expected.append(camera.project(pose.act(model.xyz[own])))
            seen.append(camera.project(pose.act(model.xyz[seen_own])))
    return shares[0], shares[1]
