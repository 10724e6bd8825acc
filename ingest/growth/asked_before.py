"""What was asked before, kept in the work folder: no question is asked twice.

Contributions and quarantined maps wait for weeks, and what is found nowhere costs more than what is.
"""

from pathlib import Path
from typing import Any

from ingest.fingerprint import digest, options_fingerprint
from ingest.growth.values import QUERY
from ingest.workspace import read_json, write_json

# Raised when the same question gets another answer: with any limit of growth (its gates, `place/`, `trust/`).
_VERSION = "5"


def recall(work: Path, kind: str, about: str, question: str = "") -> dict[str, Any] | None:
    """The answer to what was last asked about one thing of a kind, if it was this question; else None."""
    file, key = _file_and_key(work, kind, about, question)
    value = read_json(file) if file.is_file() else {}
    answer: dict[str, Any] | None = value.get("answer") if value.get("question") == key else None
    return answer


def remember(work: Path, kind: str, about: str, answer: dict[str, Any], question: str = "") -> None:
    """Note the answer, in place of that to an earlier question about the same."""
    file, key = _file_and_key(work, kind, about, question)
    write_json(file, {"question": key, "answer": answer})


def _file_and_key(work: Path, kind: str, about: str, question: str) -> tuple[Path, str]:
    file = work / "asked" / kind / f"{digest(about)[:24]}.json"
    return file, digest(_VERSION, options_fingerprint(QUERY), question)
