"""Contributed photos as values: what arrives, what is listed, and how events add up to a state. No I/O.

The table `candidates` holds events and is only appended to. A photo is named by its bytes, so that the
same bytes contributed twice, by whomever, are one candidate. What has become of it follows from its events
and from the maps that live now: being used by a map counts only while that map lives.
"""

import hashlib
import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING, Any, Literal, get_args

from featuredb.errors import InvalidValueError

if TYPE_CHECKING:
    from featuredb.store.encode import Row

CandidateState = Literal["waiting", "used", "refused", "withdrawn"]
CANDIDATE_STATES: tuple[CandidateState, ...] = get_args(CandidateState)

CONTRIBUTED, USED, REFUSED, WITHDRAWN = "contributed", "used", "refused", "withdrawn"
CONFIRMED = "confirmed"
REOPENED = "reopened"  # nothing writes it any more; what it opened waits
EVENTS = (CONTRIBUTED, USED, CONFIRMED, REFUSED, REOPENED, WITHDRAWN)

# Owners that no certificate names: whoever was not authenticated, all of them one; who keeps the database.
ANONYMOUS = "anonymous"
OPERATOR = "the operator"  # with a space, so that no client can be called so
LONGEST_NAME = 200  # of an owner, a credit, a licence, a client; longer ones are no names
_IDENTITY = "identity"  # member of a contribution's `request` in the table
_AS_GIVEN = ("candidate_id", "sha256", "size_bytes", "width", "height", "snapshot")


@dataclass(frozen=True, slots=True, kw_only=True)
class Contribution:
    """A photo that someone gives, with the query it came with and the answer it got.

    Attributes:
        width, height: of the stored picture, pixels.
        owner: the name by which who gives it was authenticated; ANONYMOUS where nobody was.
        credit, licence: whom to name with it, as the sender says, and under what terms; never empty.
        request: camera, prior, options and EXIF of the query; JSON-able.
        answer: summary of the answer (status, reason, pose, accuracy, maps), JSON-able.
        snapshot: version of the database that answered.

    Raises:
        InvalidValueError: an empty image, owner, credit or licence, a naive time, or what JSON cannot hold.
    """

    image: bytes
    width: int
    height: int
    credit: str
    licence: str
    received_at: datetime
    owner: str = ANONYMOUS
    client_id: str = ""
    request: Mapping[str, Any] = field(default_factory=dict)
    answer: Mapping[str, Any] = field(default_factory=dict)
    snapshot: int = 0

    def __post_init__(self) -> None:
        if not self.image:
            raise InvalidValueError("Contribution.image: expected the bytes of an image file, found none")
        for name in ("owner", "credit", "licence"):
            value: str = getattr(self, name)
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
    """One who gave the photo, and when; see `Contribution`."""

    owner: str
    credit: str
    licence: str
    client_id: str
    at: datetime


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateStanding:
    """What has become of a candidate.

    Attributes:
        reason_code, reason: why it was refused or withdrawn; "" otherwise.
    """

    state: CandidateState
    used_by: tuple[str, ...] = ()
    reason_code: str = ""
    reason: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate(CandidateStanding):
    """A contributed photo as its events and the living maps describe it; its bytes are loaded on demand.

    Attributes:
        candidate_id: first 32 hex digits of `sha256`.
        contributors: the first one first; later ones gave the same bytes again.
        request, answer, snapshot: of the first contribution; see `Contribution`.
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

    @property
    def owner(self) -> str:
        return self.contributors[0].owner

    @property
    def credit(self) -> str:
        return self.contributors[0].credit

    @property
    def licence(self) -> str:
        return self.contributors[0].licence

    @property
    def received_at(self) -> datetime:
        return self.contributors[0].at


def candidate_id_of(image: bytes) -> str:
    """The id of a photo: 128 bits of the SHA-256 of its bytes."""
    return hashlib.sha256(image).hexdigest()[:32]


def event_order(event: "Row") -> tuple[datetime, str, int]:
    """Sorts events by time; those of one write in the order in which they were given."""
    return event["happened_at"], event["write_id"], event["event_index"]


def standing_of(events: Sequence["Row"], live_maps: Collection[str]) -> CandidateStanding:
    """The state that a candidate's events add up to.

    The latest refusal or withdrawal decides, unless it was used after it: then it is used while one
    of those maps lives, and waits again when none does. Only giving a withdrawn photo again opens it.
    """
    latest: Row | None = None
    used: list[str] = []
    for event in events:
        kind = event["event"]
        if kind == CONFIRMED:
            continue  # says something of its owner, and nothing of what becomes of the photo
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


def request_column(contribution: Contribution) -> str:
    """What the table keeps of a contribution's request: with its owner, null for ANONYMOUS."""
    owner = None if contribution.owner == ANONYMOUS else contribution.owner
    return json.dumps({**contribution.request, _IDENTITY: owner}, sort_keys=True, allow_nan=False)


def owner_of(event: "Row") -> str:
    """Who was authenticated when a photo was contributed; what the sender claimed is no owner."""
    return str(json.loads(event["request"] or "{}").get(_IDENTITY) or ANONYMOUS)


def contributions_of(events: Iterable["Row"]) -> "list[Row]":
    """The first contribution of each owner since the photo was last withdrawn, in order."""
    found: dict[str, Row] = {}
    gone: dict[str, Row] = {}
    for event in events:
        if event["event"] == WITHDRAWN:
            gone, found = found or gone, {}
        elif event["event"] == CONTRIBUTED:
            found.setdefault(owner_of(event), event)
    return list((found or gone).values())


def candidate_of(events: Sequence["Row"], live_maps: Collection[str]) -> Candidate:
    """A candidate out of all its events, in order, among them at least one contribution.

    Its `answer` is empty where the events were read without answers.
    """
    given = contributions_of(events)
    first = given[0]
    request: dict[str, Any] = json.loads(first["request"] or "{}")
    request.pop(_IDENTITY, None)
    return Candidate(
        **asdict(standing_of(events, live_maps)),
        **{name: first[name] for name in _AS_GIVEN},
        contributors=tuple(
            Contributor(
                owner=owner_of(event),
                credit=event["owner"],
                licence=event["licence"],
                client_id=event["client_id"] or "",
                at=event["happened_at"],
            )
            for event in given
        ),
        request=request,
        answer=json.loads(first.get("answer") or "{}"),
    )
