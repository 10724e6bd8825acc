"""Control points place a reconstruction that is no map yet."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from featuredb.adjust.block import Block
from featuredb.geo.local_frame import LocalFrame
from featuredb.maps.feature_map import Placement
from ingest.colmap.bridge import Model
from ingest.photos.photo import Photo
from ingest.register.block import block_of_model, model_of_block
from ingest.register.control.control_file import ControlFile
from ingest.register.control.evidence import gcp_evidence
from ingest.register.control.marks import Control, control_frame, meet
from ingest.register.control.placement import GcpOptions, GcpPlacement, place_by_gcp
from ingest.register.control.registered_map import datum_of, gps_in, vertical_of
from ingest.register.gps import GpsPlacement
from ingest.sfm.extract import PhotoFeatures


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Survey:
    """A control point file and how it is used."""

    file: ControlFile
    options: GcpOptions = field(default_factory=GcpOptions)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControlledPlacement:
    """A reconstruction placed by control points, or why not.

    Attributes:
        placement: with residuals.
        control: what met the photos, and what did not.
        model: adjusted where the placement was accepted, in the reconstruction's own frame.
        frame: local frame of the placement.
        map_placement: for the map, None where it was refused.
        file: the control points.
        evidence: figures and residuals, JSON-able.
    """

    placement: GcpPlacement
    control: Control
    model: Model
    frame: LocalFrame
    map_placement: Placement | None
    file: ControlFile
    evidence: dict[str, Any]

    def height_datum(self, said: str) -> str:
        """Datum of the map's heights; `said` is that of the heights that the caller knows of."""
        return datum_of(self.file, self.control, said, said)


def place_by_survey(
    model: Model,
    photos: Sequence[Photo],
    features: Sequence[PhotoFeatures],
    frame: LocalFrame | None,
    by_gps: GpsPlacement,
    survey: Survey,
) -> ControlledPlacement:
    """Place and adjust a reconstruction.

    Args:
        photos, features: of its registered photos, in the order of `model.rows`.
        frame: at the photos' GPS, None where they have none.
        by_gps: what GPS says, accepted or not.
    """
    where = frame or control_frame(survey.file)
    block = block_of_model(model, photos, features)
    control = meet(survey.file, block, where)
    vertical = None
    if by_gps.reason is None and by_gps.local_from_sfm is not None and by_gps.covariance is not None:
        vertical = vertical_of(by_gps.local_from_sfm, by_gps.covariance, block.xyz, "the photos' GPS")
    gps, sigma = gps_in(where, [photo.gps for photo in photos])
    placement = place_by_gcp(
        block, control, survey.options, vertical=vertical, gps_local=gps, gps_sigma_m=sigma
    )
    evidence = gcp_evidence(placement, control) | {"file_notes": list(survey.file.notes)}
    return ControlledPlacement(
        placement=placement,
        control=control,
        model=_adjusted_model(model, block, placement),
        frame=where,
        map_placement=_map_placement(placement, evidence),
        file=survey.file,
        evidence=evidence,
    )


def _adjusted_model(model: Model, block: Block, placement: GcpPlacement) -> Model:
    if placement.reason is not None or placement.block is None or placement.local_from_block is None:
        return model
    return model_of_block(model, placement.block.moved(placement.local_from_block.inverse()))


def _map_placement(placement: GcpPlacement, evidence: dict[str, Any]) -> Placement | None:
    if placement.reason is not None or placement.local_from_block is None or placement.covariance is None:
        return None
    return Placement(
        method="gcp",
        local_from_sfm=placement.local_from_block,
        covariance=placement.covariance,
        residual_rms_m=placement.residual_rms_m,
        evidence=evidence,
    )
