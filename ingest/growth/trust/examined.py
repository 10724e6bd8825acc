"""What was found out about quarantined maps, kept in the work folder: no question is asked twice."""

from dataclasses import asdict
from pathlib import Path

from ingest.fingerprint import digest
from ingest.growth.gates import Gate
from ingest.growth.values import Refused
from ingest.workspace import read_json, write_json

# Raised when the same question gets another answer: with any limit of growth (its gates, `place/`, `trust/`).
_VERSION = "3"


def recall(work: Path | None, map_id: str, asked: str) -> Refused | None:
    """Why an earlier examination by the same question left the map as it is; None if there is none."""
    file = None if work is None else _file(work, map_id)
    if file is None or not file.is_file():
        return None
    value = read_json(file)
    if value.get("question") != digest(_VERSION, asked):
        return None
    gates = tuple(Gate(**gate) for gate in value["gates"])
    return Refused(reason=value["reason_code"], message=value["reason"], gates=gates)


def remember(work: Path | None, map_id: str, asked: str, why: Refused) -> None:
    """Note why a map stays as it is."""
    if work is None:
        return
    told = [{**asdict(gate), "passes": bool(gate.passes), "figure": float(gate.figure)} for gate in why.gates]
    question = digest(_VERSION, asked)
    write_json(
        _file(work, map_id),
        {"question": question, "reason_code": why.reason, "reason": why.message, "gates": told},
    )


def _file(work: Path, map_id: str) -> Path:
    return work / "examined" / f"{digest(map_id)[:24]}.json"
