"""Known queries: photos whose right answer is known, to be asked before maps are promoted. Table `canaries`.

A row is a canary; removing it removes the row, in one commit. The table is made by the first one. Canaries
have versions of their own: a rollback of maps leaves them alone: they say what is true, whatever maps say.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Literal

import numpy as np

from featuredb.errors import CanaryNotFoundError, InvalidValueError, StoreError
from featuredb.geo.datum import check_datum
from featuredb.geo.utm import zone_of
from featuredb.geometry.arrays import FloatArray, freeze
from featuredb.store.commits import new_write_id
from featuredb.store.database import Database
from featuredb.store.decode import of_columns, read_image, read_rows
from featuredb.store.durable.log import CHANGED, OPERATION
from featuredb.store.encode import Row, rows_table
from featuredb.store.retry import retry_stale
from featuredb.store.tables import CANARIES, SPECS, UTM_COORDINATES

Origin = Literal["person", "answer"]
LONGEST_NAME = 200
_UNIT = 1e-6  # how far the norm of a stored quaternion may be from 1
TOLERANCE_DEG = 1.0  # that an answer may be turned by; well above what more points move a pose by
_POSE_AS_STORED = ("epsg", "height_datum", "tolerance_m", "tolerance_deg")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KnownPose:
    """Where a photo was taken, and how far an answer may be from it.

    Attributes:
        epsg: UTM zone, 326zz or 327zz.
        utm: (3,) easting, northing, height of the camera centre, metres.
        height_datum: of the height; "unknown" where nobody knows.
        cam_from_utm_xyzw: (4,) unit quaternion, grid axes (east, north, up) to camera axes.
        tolerance_m: an answer further from `utm` than this is a regression.
        tolerance_deg: as is one turned by more than this.

    Raises:
        InvalidValueError, GeodesyError
    """

    epsg: int
    utm: FloatArray
    height_datum: str
    cam_from_utm_xyzw: FloatArray
    tolerance_m: float = 0.5
    tolerance_deg: float = TOLERANCE_DEG

    def __post_init__(self) -> None:
        zone_of(self.epsg)
        check_datum(self.height_datum)
        freeze(self, utm=(3,), cam_from_utm_xyzw=(4,))
        quaternion = self.cam_from_utm_xyzw
        if abs(float(np.linalg.norm(quaternion)) - 1.0) > _UNIT:
            raise InvalidValueError(
                f"KnownPose.cam_from_utm_xyzw: expected a unit quaternion, found {quaternion.tolist()}"
            )
        for name, value in (("tolerance_m", self.tolerance_m), ("tolerance_deg", self.tolerance_deg)):
            if not 0 < value < np.inf:
                raise InvalidValueError(f"KnownPose.{name}: expected a finite number > 0, found {value}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Canary:
    """A photo whose right answer is known; its bytes are loaded on demand.

    Attributes:
        canary_id: first 32 hex digits of the SHA-256 of its name.
        name: unique.
        created_at: UTC.
        request: what is asked with it (camera, prior), as on the wire.
        pose: the right answer; None: it must not be localised (a photo of another town).
        origin: "person": someone vouches for it; "answer": it is what `snapshot` answered.
    """

    canary_id: str
    name: str
    created_at: datetime
    sha256: str
    pose: KnownPose | None
    origin: Origin
    snapshot: int | None = None
    request: Mapping[str, Any] = field(default_factory=dict)


def add_canary(
    database: Database,
    name: str,
    image: bytes,
    pose: KnownPose | None,
    *,
    origin: Origin,
    snapshot: int | None = None,
    request: Mapping[str, Any] | None = None,
) -> Canary:
    """Add a known query; adding the same again changes nothing. See `Canary`.

    Raises:
        StoreError: another canary has this name, or the store failed.
        ConflictError: other writers were faster too many times.
        InvalidValueError: no name, no image, a request that JSON cannot hold, an answer without its snapshot.
    """
    if not name.strip() or len(name) > LONGEST_NAME:
        raise InvalidValueError(f"canary: expected a name of 1 to {LONGEST_NAME} characters, found {name!r}")
    if not image:
        raise InvalidValueError(f"canary {name}: expected the bytes of an image file, found none")
    if (origin == "answer") != (snapshot is not None):
        raise InvalidValueError(f"canary {name}: expected a snapshot exactly where the origin is an answer")
    try:
        asked = json.dumps(dict(request or {}), sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InvalidValueError(f"canary {name}: expected a request that JSON can hold: {error}") from error
    now = datetime.now(UTC)
    row: Row = {
        "canary_id": hashlib.sha256(name.encode()).hexdigest()[:32],
        "write_id": new_write_id(now),
        "name": name,
        "created_at": now,
        "sha256": hashlib.sha256(image).hexdigest(),
        "request": asked,
        **_pose_columns(pose),
        "origin": origin,
        "snapshot": snapshot,
        "note": "",
    }
    database.make(CANARIES)

    def attempt() -> Row:
        table = database.table(CANARIES)
        for other in read_rows(table, _light()):
            if other["name"] == name:
                return _same(other, row)
        rows = rows_table(CANARIES, [{**row, "image": image}])
        table.swap(rows, mode="append", metadata={OPERATION: "canary add", CHANGED: name})
        return row

    return _canary(retry_stale(f"add canary {name}", attempt))


def list_canaries(database: Database) -> list[Canary]:
    """All known queries, by name."""
    return sorted(map(_canary, database.rows(CANARIES, _light())), key=lambda canary: canary.name)


def remove_canary(database: Database, name: str) -> None:
    """Remove a known query.

    Raises:
        CanaryNotFoundError, ConflictError, StoreError
    """
    mine = [row["canary_id"] for row in database.rows(CANARIES, _light()) if row["name"] == name]
    if not mine:
        raise CanaryNotFoundError(f"no canary {name!r}; `featuredb canary list` lists what there is")
    database.table(CANARIES).delete_rows("canary_id", mine, {OPERATION: "canary remove", CHANGED: name})


def load_canary_image(database: Database, canary: Canary) -> bytes:
    """The bytes of a canary's photo.

    Raises:
        CanaryNotFoundError: it was removed.
        StoreError: they cannot be read, or are not those that were added.
    """
    if not database.has(CANARIES):
        raise CanaryNotFoundError(f"no canary {canary.name!r}")
    table = database.table(CANARIES)
    image = read_image(table, "canary_id", canary.canary_id, f"canary {canary.name}")
    if image is None:
        raise CanaryNotFoundError(f"canary {canary.name!r} was removed")
    if hashlib.sha256(image).hexdigest() != canary.sha256:
        raise StoreError(f"canary {canary.name}: its image is not the one that was added")
    return image


def _light() -> list[str]:
    """All columns but the photo's bytes."""
    return [name for name in SPECS[CANARIES].schema.names if name != "image"]


def _same(there: Row, wanted: Row) -> Row:
    """The row that is there, if it says the same."""
    differing = [k for k in _light() if k not in ("write_id", "created_at") and there[k] != wanted.get(k)]
    if differing:
        raise StoreError(
            f"there is a canary {wanted['name']!r} with another {', '.join(differing)}; "
            "remove it first, or choose another name"
        )
    return there


def _pose_columns(pose: KnownPose | None) -> Row:
    if pose is None:
        return {"expected": "not_localised"}
    return {
        "expected": "localised",
        **{name: getattr(pose, name) for name in _POSE_AS_STORED},
        **dict(zip(UTM_COORDINATES, pose.utm.tolist(), strict=True)),
        "cam_from_utm_xyzw": pose.cam_from_utm_xyzw.tolist(),
    }


def _canary(row: Row) -> Canary:
    try:
        pose = None
        if row["expected"] == "localised":
            utm, turn = np.array([row[name] for name in UTM_COORDINATES]), np.array(row["cam_from_utm_xyzw"])
            pose = of_columns(KnownPose, {**row, "utm": utm, "cam_from_utm_xyzw": turn})
        return of_columns(Canary, {**row, "request": json.loads(row["request"]), "pose": pose})
    except (TypeError, ValueError) as error:
        raise StoreError(
            f"canary {row['name']}: its row is damaged ({error}); run `featuredb verify`"
        ) from error
