"""Contributed photos as values: what arrives, what is listed, and how events add up to a state. No I/O.

The table `candidates` holds events and is only appended to. A photo is named by its bytes, so that the
same bytes contributed twice, by whomever, are one candidate. What has become of it follows from its events
and from the maps that live now: being used by a map counts only while that map lives.
"""

import hashlib
import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING, Any, Literal, get_args

from featuredb.errors import InvalidValueError

if TYPE_CHECKING:
    from featuredb.store.encode import Row

CandidateState = Literal["waiting", "used", "refused", "withdrawn"]
CANDIDATE_STATES: tuple[CandidateState, ...] = get_args(CandidateState)

CONTRIBUTED, USED, REFUSED, REOPENED, WITHDRAWN = "contributed", "used", "refused", "reopened", "withdrawn"

LONGEST_NAME = 200  # of an owner, a licence, a client; longer ones are no names


@dataclass(frozen=True, slots=True, kw_only=True)
class Contribution:
    """A photo that someone gives, with the query it came with and the answer it got.

    Attributes:
        image: bytes of the image file.
        width, height: of the stored picture, pixels.
        owner, licence: who gives it, and under what terms; never empty.
        client_id: what the sender calls itself, "" where it does not.
        received_at: aware time.
        request: camera, prior, options and EXIF of the query, and `identity`: the name by which its client
            was authenticated, None where it was not; JSON-able.
        answer: summary of the answer (status, reason, pose, accuracy, maps), JSON-able.
        snapshot: version of the database that answered.

    Raises:
        InvalidValueError: an empty image, owner or licence, a naive time, or what JSON cannot hold.
    """

    image: bytes
    width: int
    height: int
    owner: str
    licence: str
    received_at: datetime
    client_id: str = ""
    request: Mapping[str, Any] = field(default_factory=dict)
    answer: Mapping[str, Any] = field(default_factory=dict)
    snapshot: int = 0

    def __post_init__(self) -> None:
        if not self.image:
            raise InvalidValueError("Contribution.image: expected the bytes of an image file, found none")
        for name, value in (("owner", self.owner), ("licence", self.licence)):
            if not value.strip() or len(value) > LONGEST_NAME:
                raise InvalidValueError(
                    f"Contribution.{name}: expected 1 to {LONGEST_NAME} characters, found {value[:50]!r}"
                )
        if self.received_at.tzinfo is None:
            raise InvalidValueError("Contribution.received_at: expected a time with a time zone")
        try:
            json.dumps([dict(self.request), dict(self.answer)], allow_nan=False)
        except (TypeError, ValueError) as error:
            raise InvalidValueError(f"Contribution: expected values that JSON can hold: {error}") from error


@dataclass(frozen=True, slots=True, kw_only=True)
class Contributor:
    """One who gave the photo, and when."""

    owner: str
    licence: str
    client_id: str
    at: datetime


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A contributed photo as its events and the living maps describe it; its bytes are loaded on demand.

    Attributes:
        candidate_id: first 32 hex digits of `sha256`.
        sha256: of the image file's bytes.
        contributors: the first one first; later ones gave the same bytes again.
        received_at: of the first contribution.
        request, answer, snapshot: of the first contribution; see `Contribution`.
        state: waiting, used (by a map that lives), refused or withdrawn.
        used_by: the living maps that use it.
        reason_code, reason: why it was refused or withdrawn; "" otherwise.
    """

    candidate_id: str
    sha256: str
    size_bytes: int
    width: int
    height: int
    contributors: tuple[Contributor, ...]
    request: dict[str, Any]
    answer: dict[str, Any]
    snapshot: int
    state: CandidateState
    used_by: tuple[str, ...]
    reason_code: str
    reason: str

    @property
    def owner(self) -> str:
        return self.contributors[0].owner

    @property
    def licence(self) -> str:
        return self.contributors[0].licence

    @property
    def received_at(self) -> datetime:
        return self.contributors[0].at


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateStanding:
    """What has become of a candidate; see `Candidate`."""

    state: CandidateState
    used_by: tuple[str, ...] = ()
    reason_code: str = ""
    reason: str = ""


def candidate_id_of(image: bytes) -> str:
    """The id of a photo: 128 bits of the SHA-256 of its bytes."""
    return hashlib.sha256(image).hexdigest()[:32]


def event_order(event: "Row") -> tuple[datetime, str, int]:
    """Sorts events by time; those of one write in the order in which they were given."""
    return event["happened_at"], event["write_id"], event["event_index"]


def standing_of(events: Sequence["Row"], live_maps: Collection[str]) -> CandidateStanding:
    """The state that a candidate's events add up to.

    The latest refusal, withdrawal or opening decides, unless it was used after it: then it is used while one
    of those maps lives, and waits again when none does. Only giving a withdrawn photo again opens it.

    Args:
        events: of one candidate, in order.
        live_maps: ids of the maps that are not retired.
    """
    latest: Row | None = None
    used: list[str] = []
    for event in events:
        kind = event["event"]
        if kind == USED:
            if latest is None or latest["event"] != WITHDRAWN:  # noted too late, the bytes are gone
                used.append(event["map_id"])
        elif kind in (REFUSED, REOPENED, WITHDRAWN) or (latest is not None and latest["event"] == WITHDRAWN):
            latest, used = event, []
    if used:
        living = tuple(m for m in dict.fromkeys(used) if m in live_maps)
        return (
            CandidateStanding(state="used", used_by=living) if living else CandidateStanding(state="waiting")
        )
    if latest is None or latest["event"] in (REOPENED, CONTRIBUTED):
        return CandidateStanding(state="waiting")
    return CandidateStanding(
        state="refused" if latest["event"] == REFUSED else "withdrawn",
        reason_code=latest["reason_code"] or "",
        reason=latest["reason"] or "",
    )


def contributors_of(events: Iterable["Row"]) -> tuple[Contributor, ...]:
    """Those who gave the photo, each owner once, by their first contribution since it was last withdrawn."""
    found: dict[str, Contributor] = {}
    gone: dict[str, Contributor] = {}
    for event in events:
        if event["event"] == WITHDRAWN:
            gone, found = found or gone, {}
        elif event["event"] == CONTRIBUTED:
            found.setdefault(
                event["owner"],
                Contributor(
                    owner=event["owner"],
                    licence=event["licence"],
                    client_id=event["client_id"] or "",
                    at=event["happened_at"],
                ),
            )
    return tuple((found or gone).values())


def candidate_of(events: Sequence["Row"], live_maps: Collection[str]) -> Candidate:
    """A candidate out of all its events, in order, among them at least one contribution."""
    given = [event for event in events if event["event"] == CONTRIBUTED]
    contributors = contributors_of(events)
    first = next(
        e for e in given if e["happened_at"] == contributors[0].at and e["owner"] == contributors[0].owner
    )
    standing = standing_of(events, live_maps)
    return Candidate(
        candidate_id=first["candidate_id"],
        sha256=first["sha256"],
        size_bytes=first["size_bytes"],
        width=first["width"],
        height=first["height"],
        contributors=contributors,
        request=json.loads(first["request"] or "{}"),
        answer=json.loads(first["answer"] or "{}"),
        snapshot=first["snapshot"],
        state=standing.state,
        used_by=standing.used_by,
        reason_code=standing.reason_code,
        reason=standing.reason,
    )
