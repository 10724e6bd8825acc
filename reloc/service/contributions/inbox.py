"""Contributed photos on their way from a query to the database: a bounded queue and one thread that writes.

A query never waits for the store: a place in the queue is reserved before the answer is sent and used after
it. What cannot be taken is refused with a reason, and the query is answered all the same.
"""

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import datetime

from featuredb.features.exif.read import read_exif
from featuredb.features.image_header import read_header
from featuredb.store.candidates.photos import InboxCounts
from featuredb.store.candidates.states import Contribution
from reloc.service.logs import fields
from reloc.wire.query import ContributionReason, ContributionReply, LocaliseReply, LocaliseWireRequest
from reloc.wire.server import ContributionStatus

logger = logging.getLogger(__name__)

_ANSWER = {
    "request_id", "status", "reason", "detail", "position", "utm", "height_datum", "covariance", "accuracy",
    "confidence", "camera", "matches", "inliers", "residual_rms_px", "maps",
}  # fmt: skip


def contribution_of(
    data: bytes, request: LocaliseWireRequest, reply: LocaliseReply, received_at: datetime, owner: str
) -> Contribution:
    """The row of a contributed photo out of its query, which has been answered and found valid.

    `owner`: the name by which the client was authenticated, ANONYMOUS where it was not.
    """
    header = read_header(data)
    exif = {k: v for k, v in asdict(read_exif(data, header)).items() if v not in (None, "", ())}
    exif = {k: v.isoformat() if isinstance(v, datetime) else v for k, v in exif.items()}
    asked = request.model_dump(mode="json", include={"request_id", "camera", "prior", "options"})
    return Contribution(
        image=data,
        width=header.width,
        height=header.height,
        owner=owner,
        **{name: getattr(request, name) or "" for name in ("credit", "licence", "client_id")},
        received_at=received_at,
        request={**asked, "exif": exif},
        answer=reply.model_dump(mode="json", include=_ANSWER),
        snapshot=reply.snapshot,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class InboxOptions:
    """Bounds of the inbox."""

    max_queue: int = 32  # photos that wait for the writing thread
    max_queued_bytes: int = 256 * 2**20
    # Photos of one owner (an identity; all who have none are one) that wait for growth; a day's walk has some
    # hundreds, and one owner cannot crowd out the others.
    max_owner_photos: int = 2_000
    max_photos: int = 20_000  # of all owners that wait for growth
    max_stored_bytes: int = 40 * 2**30  # of all stored photos, whatever has become of them
    batch: int = 8  # photos that are written in one commit
    refresh_s: float = 30.0  # how old the counts may be by which these limits of what is stored are judged
    retry_s: tuple[float, ...] = (0.5, 2.0, 8.0, 30.0)  # pauses before a failed write is tried again


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ticket:
    """A place in the queue for a photo of `size` bytes; `submit` or `cancel` must be called with it, once."""

    owner: str
    size: int


_Given = tuple[Ticket, Callable[[], Contribution]]


class Inbox:
    """Takes photos from the workers; they share it."""

    def __init__(
        self,
        write: Callable[[list[Contribution]], object],  # in one append; may take seconds, and fail
        count: Callable[[], InboxCounts],  # how much is stored; likewise
        options: InboxOptions | None = None,
    ) -> None:
        self._store, self._count = write, count
        self._options = options or InboxOptions()
        self._changed = threading.Condition()
        self._queue: deque[_Given] = deque()
        self._places: set[Ticket] = set()  # that are given out and not yet written
        self._counts = InboxCounts(by_state={}, waiting_by_owner={}, stored_bytes=0)
        self._counted_at = -1e9
        self._asked = False  # someone wanted a place since the counts were taken
        self._accepted = self._written = self._lost = 0
        self._refused: Counter[str] = Counter()
        self._error: str | None = None
        self._closed = False
        self._stop = threading.Event()  # ends the pauses between retries
        self._thread = threading.Thread(target=self._run, name="inbox", daemon=True)

    def start(self) -> None:
        """Count what is there and begin to write. A store that fails is told by `status` and refusals."""
        self._refresh()
        self._thread.start()

    def close(self, timeout_s: float) -> None:
        """Write what is queued, at most for this long; take no more."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._stop.set()
        self._thread.join(timeout_s)
        with self._changed:
            if self._thread.is_alive():  # with a batch in hand that the store may still take
                _lost(len(self._places), "the server stopped before the store took them")

    def reserve(self, owner: str, size: int) -> Ticket | ContributionReply:
        """A place for a photo of `size` bytes, or why there is none. Returns at once."""
        with self._changed:
            self._asked = True
            refusal = self._refusal(owner, size)
            if refusal is not None:
                reason, detail = refusal
                self._refused[reason] += 1
                return ContributionReply(accepted=False, candidate_id=None, reason=reason, detail=detail)
            place = Ticket(owner=owner, size=size)
            self._places.add(place)
            return place

    def submit(self, ticket: Ticket, make: Callable[[], Contribution]) -> None:
        """Give the photo; `make` is called by the writing thread."""
        with self._changed:
            self._queue.append((ticket, make))
            self._accepted += 1
            self._changed.notify()

    def cancel(self, ticket: Ticket) -> None:
        """Give the place back."""
        with self._changed:
            self._places.remove(ticket)

    def status(self) -> ContributionStatus:
        """For `.../status`."""
        with self._changed:
            return ContributionStatus(
                accepted=self._accepted,
                refused=dict(sorted(self._refused.items())),
                waiting=len(self._places),
                written=self._written,
                lost=self._lost,
                error=self._error,
            )

    def _refusal(self, owner: str, size: int) -> tuple[ContributionReason, str] | None:
        options, counts = self._options, self._counts
        if self._error is not None or self._closed:
            why = self._error or "the server is stopping"
            return "STORE_FAILED", f"the inbox cannot be written: {why}"
        queued, queued_bytes = len(self._places), sum(place.size for place in self._places)
        if queued >= options.max_queue or queued_bytes + size > options.max_queued_bytes:
            told = f"{queued} contributed photos ({queued_bytes} bytes) wait to be stored"
            return "QUEUE_FULL", f"{told}; send it again in a few seconds"
        mine = counts.waiting_by_owner.get(owner, 0) + sum(place.owner == owner for place in self._places)
        stored = counts.stored_bytes + queued_bytes
        waiting = counts.waiting + queued
        of_owner = f"{mine} photos of this owner wait for growth, which is as many as one owner may have"
        of_all = f"{waiting} photos wait for growth, which is the limit"
        of_bytes = f"the stored photos take {stored} of {options.max_stored_bytes} bytes"
        limits: tuple[tuple[bool, ContributionReason, str], ...] = (
            (mine >= options.max_owner_photos, "OWNER_LIMIT", of_owner),
            (waiting >= options.max_photos, "INBOX_FULL", of_all),
            (stored + size > options.max_stored_bytes, "INBOX_FULL", of_bytes),
        )
        return next(((reason, told) for reached, reason, told in limits if reached), None)

    def _run(self) -> None:
        while True:
            with self._changed:
                if not self._queue and not self._closed:
                    self._changed.wait(self._options.refresh_s)
                if not self._queue and self._closed:
                    return
                batch = [self._queue.popleft() for _ in range(min(len(self._queue), self._options.batch))]
            if batch:
                self._write(batch)
            due = time.monotonic() - self._counted_at >= self._options.refresh_s
            if due and (self._asked or self._error is not None):
                self._refresh()

    def _write(self, batch: list[_Given]) -> None:
        made = [(ticket, one) for ticket, make in batch if (one := _made(make)) is not None]
        if not (made and self._write_with_retries([one for _, one in made])):
            made = []
        with self._changed:
            self._written += len(made)
            self._lost += len(batch) - len(made)
            waiting = Counter(self._counts.waiting_by_owner) + Counter(ticket.owner for ticket, _ in made)
            states = Counter(self._counts.by_state) + Counter(waiting=len(made))
            stored = self._counts.stored_bytes + sum(ticket.size for ticket, _ in made)
            self._counts = InboxCounts(
                by_state=dict(states), waiting_by_owner=dict(waiting), stored_bytes=stored
            )
        for ticket, _ in batch:
            self.cancel(ticket)

    def _write_with_retries(self, contributions: list[Contribution]) -> bool:
        for pause_s in (*self._options.retry_s, None):
            try:
                self._store(contributions)
            except Exception as error:
                # A store may break in many ways; the thread must live on, or photos would be lost for ever.
                logger.warning("inbox: a write failed", exc_info=True, extra=fields("inbox_failed"))
                with self._changed:
                    self._error = f"{type(error).__name__}: {error}"
                if pause_s is None or self._stop.wait(pause_s):
                    break
            else:
                with self._changed:
                    self._error = None
                return True
        _lost(len(contributions), "the store does not take them")
        return False

    def _refresh(self) -> None:
        """Take new counts; a store that answers again is trusted again."""
        try:
            counts, error = self._count(), None
        except Exception as failure:  # as for a write
            counts, error = None, f"{type(failure).__name__}: {failure}"
            logger.warning("inbox: cannot be counted", exc_info=True, extra=fields("inbox_failed"))
        with self._changed:
            self._counts = counts or self._counts
            self._error = error
            self._counted_at = time.monotonic()
            self._asked = False


def _made(make: Callable[[], Contribution]) -> Contribution | None:
    """The contribution; one that cannot be made must not take the others with it."""
    try:
        return make()
    except Exception:
        logger.exception("contribution lost", extra=fields("contributions_lost", count=1))
        return None


def _lost(count: int, why: str) -> None:
    logger.error("contributions lost: %s", why, extra=fields("contributions_lost", count=count))
