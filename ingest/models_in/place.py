"""Where a model lies on Earth: as its geo-reference says, as a person says, by its photos' GPS, or not."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from featuredb.errors import FeatureDbError, IngestError
from featuredb.export.georeference import FORMAT, GEOREFERENCE
from featuredb.geo.local_frame import LocalFrame
from featuredb.geo.projections import geodetic_from_ecef
from featuredb.geo.utm import geodetic_from_utm, utm_epsg, zone_of
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3, similarity_closed_form
from featuredb.maps.feature_map import MAP_METHODS, MapStatus, Placement
from featuredb.maps.unplaced_map import NoPlace
from ingest.colmap.bridge import Model
from ingest.own_frame import WAYS_TO_A_PLACE
from ingest.photos.photo import Photo
from ingest.placed_models import placed_by_gps

Axes = Literal["enu", "utm", "ecef"]
# A model in UTM is not a similarity of the place: heights are unscaled, the plane by up to 0.04 %. What the
# best similarity leaves of that is below a thousandth of the model's size; more means that it is no UTM.
_MOST_MISFIT = 1e-3
_MOST_FROM_REFERENCE_M = 100_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Stated:
    """What a person says of the model's coordinates.

    Attributes:
        axes: "enu": east, north, up in metres at `origin`; "utm": easting, northing, height, `origin` to be
            added; "ecef": geocentric X, Y, Z.
        epsg: UTM zone of `origin`, and of the map.
        origin: (easting, northing, height) in metres.
        sigma_m: how well the place is known, horizontally and vertically, one standard deviation.
    """

    axes: Axes
    epsg: int
    origin: tuple[float, float, float]
    sigma_m: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Place:
    """A model's place.

    Attributes:
        frame: local frame of the map. placement: leads there from the model's coordinates.
        height_datum: of all heights; None: whoever imports says.
        status: quarantined where nothing in this database vouches for the place.
    """

    frame: LocalFrame
    placement: Placement
    epsg: int
    height_datum: str | None = None
    status: MapStatus = "active"


def place_of_georeference(document: Mapping[str, Any]) -> Place | NoPlace:
    """As our own export says. A map that other maps had placed comes in quarantine: they may not be here.

    A map that had no place has none here.

    Raises:
        IngestError: not such a document.
    """
    if document.get("format") != FORMAT:
        raise IngestError(
            f"{GEOREFERENCE}: expected the format {FORMAT!r}, found {document.get('format')!r}; move it "
            "away and give --epsg, --origin and --sigma"
        )
    try:
        if document["placement"] is None:
            why = document["no_place"]
            return NoPlace(
                reason_code=str(why["reason_code"]), reason=str(why["reason"]), ways=WAYS_TO_A_PLACE
            )
        origin, placed = document["frame"]["origin"], document["placement"]
        method = placed["method"]
        if method not in MAP_METHODS:
            raise IngestError(
                f"{GEOREFERENCE}: expected a method of {', '.join(MAP_METHODS)}, found {method!r}"
            )
        return Place(
            frame=LocalFrame(
                latitude_deg=origin["latitude_deg"],
                longitude_deg=origin["longitude_deg"],
                height_m=origin["height_m"],
            ),
            placement=Placement(
                method=method,
                local_from_sfm=Sim3.identity(),
                covariance=np.array(placed["covariance"], dtype=np.float64),
                residual_rms_m=float(placed["residual_rms_m"]),
                evidence={"imported": GEOREFERENCE, "map_id": document["map"]["id"]},
            ),
            epsg=int(document["utm"]["epsg"]),
            height_datum=str(document["crs"]["height_datum"]),
            status="quarantined" if method == "map" else "active",
        )
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, FeatureDbError):
            raise
        raise IngestError(f"{GEOREFERENCE}: broken or incomplete: {error!r}") from error


def place_as_stated(model: Model, stated: Stated) -> Place:
    """As a person says; the covariance is that of `sigma_m` over the cameras' spread.

    Raises:
        IngestError: coordinates that cannot be what they are said to be.
        GeodesyError: no UTM zone, or an origin that is nowhere in it.
    """
    zone_of(stated.epsg)
    centers = model.centers()
    own_from_model, frame, residual_m = _to_local(model, centers, stated)
    said = f"axes {stated.axes}, EPSG:{stated.epsg}, origin {list(stated.origin)}"
    placement = _vouched(own_from_model, centers, stated.sigma_m, residual_m, said)
    return Place(frame=frame, placement=placement, epsg=stated.epsg)


def place_at_reference(model: Model, reference: LocalFrame, sigma_m: tuple[float, float]) -> Place:
    """In the frame of the model's own reference, as surely as a person says.

    Raises:
        IngestError: cameras so far from it that it cannot be theirs.
    """
    centers = model.centers()
    farthest = float(np.linalg.norm(centers, axis=1).max())
    if farthest > _MOST_FROM_REFERENCE_M:
        raise IngestError(
            f"expected cameras within {_MOST_FROM_REFERENCE_M / 1000:.0f} km of the model's reference, "
            f"found one at {farthest / 1000:.0f} km: the coordinates are no metres in its frame; give "
            "--epsg, --origin and --axes with --sigma"
        )
    placement = _vouched(Sim3.identity(), centers, sigma_m, 0.0, "the model's own reference")
    epsg = utm_epsg(reference.latitude_deg, reference.longitude_deg)
    return Place(frame=reference, placement=placement, epsg=epsg)


def place_by_photos(model: Model, photos: Sequence[Photo]) -> Place | NoPlace:
    """By the GPS of the photos, with the gates of an ordinary ingest; or why they refuse it."""
    frame, _, placed = placed_by_gps(model, photos)
    if (
        placed.reason is not None
        or placed.local_from_sfm is None
        or placed.covariance is None
        or frame is None
    ):
        known_place = "its coordinates, where they are known: import it with --epsg, --origin and --sigma"
        return NoPlace(
            reason_code=placed.reason or "TOO_FEW",
            reason=f"the model cannot be placed by its photos' GPS: {placed.message}",
            ways=(known_place, *WAYS_TO_A_PLACE),
            evidence=placed.figures,
        )
    return Place(
        frame=frame,
        placement=Placement(
            method="gps",
            local_from_sfm=placed.local_from_sfm,
            covariance=placed.covariance,
            residual_rms_m=placed.residual_rms_m,
            evidence=placed.figures,
        ),
        epsg=utm_epsg(frame.latitude_deg, frame.longitude_deg),
        status="quarantined" if placed.provisional else "active",
    )


def _to_local(model: Model, centers: FloatArray, stated: Stated) -> tuple[Sim3, LocalFrame, float]:
    """The similarity from the model to a local frame near its cameras, and what it leaves, metres RMS."""
    middle = np.median(centers, axis=0)
    if stated.axes == "enu":
        there = LocalFrame.from_utm(*stated.origin, stated.epsg)
        frame = LocalFrame.about(there.geodetic_from_enu(middle))
        return Sim3.from_rigid3(frame.enu_from(there)), frame, 0.0
    if stated.axes == "ecef":
        radius_km = float(np.linalg.norm(middle)) / 1000.0
        if not 6300.0 < radius_km < 6400.0:
            raise IngestError(
                f"--axes ecef: expected cameras some 6,370 km from the Earth's centre, found {radius_km:.1f}"
            )
        frame = LocalFrame.about(geodetic_from_ecef(middle[None])[0])
        return Sim3.from_rigid3(frame.ecef_from_enu().inverse()), frame, 0.0
    utm = np.concatenate([centers, model.xyz]) + stated.origin
    frame = LocalFrame.about(geodetic_from_utm(middle + stated.origin, stated.epsg))
    enu = frame.enu_from_utm(utm, stated.epsg)
    fitted = similarity_closed_form(utm - stated.origin, enu)
    if fitted is None:
        raise IngestError("--axes utm: the model's cameras and points coincide")
    residual = np.sqrt(((fitted.act(utm - stated.origin) - enu) ** 2).sum(axis=1).mean())
    size = float(np.sqrt(((enu - enu.mean(axis=0)) ** 2).sum(axis=1).mean()))
    if residual > _MOST_MISFIT * max(size, 1.0):
        raise IngestError(
            f"--axes utm: with origin {stated.origin} the coordinates are no UTM of EPSG:{stated.epsg}: "
            f"{residual:.2f} m are left over {size:.0f} m"
        )
    return fitted, frame, float(residual)


def _vouched(
    local_from_model: Sim3, centers: FloatArray, sigma_m: tuple[float, float], residual_m: float, said: str
) -> Placement:
    """A placement that a person answers for, known so well over the spread of the cameras (k, 3)."""
    horizontal, vertical = sigma_m
    local = local_from_model.act(centers)
    relative = horizontal / max(float(np.sqrt(((local - local.mean(axis=0)) ** 2).sum(axis=1).mean())), 1.0)
    return Placement(
        method="gcp",
        local_from_sfm=local_from_model,
        covariance=np.diag([relative**2] * 4 + [horizontal**2, horizontal**2, vertical**2]),
        residual_rms_m=residual_m,
        evidence={"imported": said, "sigma_m": str(list(sigma_m))},
    )
