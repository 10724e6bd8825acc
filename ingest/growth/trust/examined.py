"""What was found out about quarantined maps, kept in the work folder: no question is asked twice."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from featuredb.store import Database, Snapshot
from featuredb.store.canaries import list_canaries
from ingest.fingerprint import digest, options_fingerprint
from ingest.growth.gates import Gate
from ingest.growth.place.localised import QUERY
from ingest.growth.trust.confirmation import ConfirmationOptions
from ingest.workspace import read_json, write_json

# Raised when the same question gets another answer: with any limit of growth (its gates, `place/`, `trust/`).
_VERSION = "3"


def question(
    database: Database, snapshot: Snapshot, photos: Sequence[str], options: ConfirmationOptions
) -> str:
    """Digest of all that an examination depends on: live maps, canaries, photos (their digests), options."""
    maps = sorted(f"{m.write_id} {m.status}" for m in snapshot.maps())
    canaries = [f"{c.name} {c.created_at.isoformat()}" for c in list_canaries(database)]
    asks = options_fingerprint(options, QUERY)
    return digest(asks, *maps, "|", *canaries, "|", *sorted(photos))


def recall(work: Path | None, map_id: str, asked: str) -> tuple[str, str, tuple[Gate, ...]] | None:
    """Reason code, reason and gates of an earlier examination by the same question; None if there is none."""
    file = None if work is None else _file(work, map_id)
    if file is None or not file.is_file():
        return None
    value = read_json(file)
    if value.get("question") != digest(_VERSION, asked):
        return None
    return value["reason_code"], value["reason"], tuple(Gate(**gate) for gate in value["gates"])


def remember(
    work: Path | None, map_id: str, asked: str, reason_code: str, reason: str, gates: Sequence[Gate]
) -> None:
    """Note why a map stays in quarantine."""
    if work is None:
        return
    told = [{**asdict(gate), "passes": bool(gate.passes), "figure": float(gate.figure)} for gate in gates]
    write_json(
        _file(work, map_id),
        {"question": digest(_VERSION, asked), "reason_code": reason_code, "reason": reason, "gates": told},
    )


def _file(work: Path, map_id: str) -> Path:
    return work / "examined" / f"{digest(map_id)[:24]}.json"
