"""The inbox of a server: places in its queue, limits, a store that is slow or fails."""

import threading
import time

import pytest

from featuredb.errors import StoreError
from featuredb.store.candidates.photos import InboxCounts
from featuredb.store.candidates.states import Contribution
from reloc.service.contributions.inbox import Inbox, InboxOptions, Ticket
from reloc.wire.query import ContributionReply
from tests.support.contributions import contribution
from tests.support.service import Gate, MemoryInbox

QUICK = InboxOptions(retry_s=(0.0, 0.0), refresh_s=0.02)
WAIT_S = 20.0


def until(condition, what: str) -> None:
    end = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end, f"never: {what}"
        time.sleep(0.002)


def give(inbox: Inbox, one: Contribution) -> Ticket | ContributionReply:
    place = inbox.reserve(one.owner, len(one.image))
    if isinstance(place, Ticket):
        inbox.submit(place, lambda: one)
    return place


def reason(place: Ticket | ContributionReply) -> str:
    return place.reason if isinstance(place, ContributionReply) else "taken"


@pytest.fixture
def store():
    return MemoryInbox()


@pytest.fixture
def opened(store):
    """Makes started inboxes; closes them and lets a held store go."""
    made = []

    def make(options: InboxOptions = QUICK) -> Inbox:
        inbox = Inbox(lambda given: store.write(given), lambda: store.counts(), options)
        inbox.start()
        made.append(inbox)
        return inbox

    yield make
    if store.gate is not None:
        store.gate.open()
    for inbox in made:
        inbox.close(WAIT_S)


def test_what_is_given_is_written_in_order(store, opened):
    inbox = opened()
    given = [contribution(i) for i in range(20)]
    assert [reason(give(inbox, one)) for one in given] == ["taken"] * 20
    inbox.close(WAIT_S)
    assert store.written == given
    status = inbox.status()
    assert (status.accepted, status.written, status.waiting, status.lost) == (20, 20, 0, 0)


def test_a_place_that_is_given_back(store, opened):
    inbox = opened(InboxOptions(max_queue=1))
    place = inbox.reserve("Ada", 10)
    assert reason(inbox.reserve("Ada", 10)) == "QUEUE_FULL"
    inbox.cancel(place)
    assert reason(give(inbox, contribution(1))) == "taken"
    inbox.close(WAIT_S)
    assert len(store.written) == 1
    assert inbox.status().accepted == 1


def test_nobody_waits_for_a_store_that_is_slow(store, opened):
    store.gate = Gate()
    inbox = opened(InboxOptions(max_queue=4, batch=2))
    start = time.perf_counter()
    told = [reason(give(inbox, contribution(i))) for i in range(10)]
    assert time.perf_counter() - start < 1.0
    assert told == ["taken"] * 4 + ["QUEUE_FULL"] * 6
    assert inbox.status().waiting == 4
    store.gate.open()
    until(lambda: inbox.status().waiting == 0, "the queue is written")
    assert reason(give(inbox, contribution(11))) == "taken"
    inbox.close(WAIT_S)
    assert len(store.written) == 5
    assert inbox.status().refused == {"QUEUE_FULL": 6}


def test_the_queue_is_bounded_in_bytes(store, opened):
    store.gate = Gate()
    size = len(contribution().image)
    inbox = opened(InboxOptions(max_queued_bytes=2 * size + size // 2))
    assert [reason(give(inbox, contribution(i))) for i in range(3)] == ["taken", "taken", "QUEUE_FULL"]


def test_an_owner_cannot_crowd_out_the_others(store, opened):
    store.stored = InboxCounts(
        by_state={"waiting": 2, "used": 9}, waiting_by_owner={"Ada": 2}, stored_bytes=0
    )
    inbox = opened(InboxOptions(max_owner_photos=3))
    assert reason(give(inbox, contribution(1, "Ada"))) == "taken"
    refusal = give(inbox, contribution(2, "Ada"))
    assert reason(refusal) == "OWNER_LIMIT"
    assert refusal.detail.startswith("3 photos of this owner wait")
    assert reason(give(inbox, contribution(3, "Bob"))) == "taken"
    until(lambda: inbox.status().written == 2, "both are written")
    assert reason(give(inbox, contribution(2, "Ada"))) == "OWNER_LIMIT", "what is written counts as well"


def test_the_inbox_is_bounded_in_photos_and_in_bytes(store, opened):
    store.stored = InboxCounts(by_state={"waiting": 5}, waiting_by_owner={"Ada": 5}, stored_bytes=10_000)
    by_count = opened(InboxOptions(max_photos=6))
    assert [reason(give(by_count, contribution(i, "Bob"))) for i in range(2)] == ["taken", "INBOX_FULL"]
    size = len(contribution().image)
    by_bytes = opened(InboxOptions(max_stored_bytes=10_000 + size))
    assert reason(give(by_bytes, contribution(1, "Bob"))) == "taken"
    refusal = give(by_bytes, contribution(2, "Bob"))
    assert reason(refusal) == "INBOX_FULL"
    assert f"of {10_000 + size} bytes" in refusal.detail


def test_growth_makes_room(store, opened):
    """A refusal by the counts makes the inbox look again, though nothing is written any more."""
    store.stored = InboxCounts(by_state={"waiting": 3}, waiting_by_owner={"Ada": 3}, stored_bytes=0)
    inbox = opened(InboxOptions(max_owner_photos=3, refresh_s=0.02))
    assert reason(give(inbox, contribution(1, "Ada"))) == "OWNER_LIMIT"
    store.stored = InboxCounts(by_state={"used": 3}, waiting_by_owner={}, stored_bytes=0)
    until(lambda: reason(give(inbox, contribution(1, "Ada"))) == "taken", "there is room")


def test_a_store_that_fails_once_loses_nothing(store, opened):
    store.failure = StoreError("bucket unreachable")
    inbox = opened(InboxOptions(retry_s=(0.02,) * 1000))
    assert reason(give(inbox, contribution(1))) == "taken"
    until(lambda: inbox.status().error is not None, "the failure is told")
    refusal = give(inbox, contribution(2))
    assert reason(refusal) == "STORE_FAILED"
    assert "bucket unreachable" in refusal.detail
    store.failure = None
    until(lambda: inbox.status().written == 1, "it is written")
    assert inbox.status().error is None
    assert reason(give(inbox, contribution(2))) == "taken"
    inbox.close(WAIT_S)
    assert [c.image for c in store.written] == [contribution(1).image, contribution(2).image]


def test_a_store_that_keeps_failing_is_given_up_and_asked_again_later(store, opened, caplog):
    store.failure = StoreError("read-only")
    inbox = opened(InboxOptions(retry_s=(0.0, 0.0), refresh_s=0.02))
    give(inbox, contribution(1))
    until(lambda: inbox.status().lost == 1, "it is given up")
    assert store.attempts == 3
    assert any(getattr(r, "fields", {}).get("event") == "contributions_lost" for r in caplog.records)
    store.failure = None
    until(lambda: reason(give(inbox, contribution(2))) == "taken", "the store is trusted again")
    inbox.close(WAIT_S)
    assert [c.image for c in store.written] == [contribution(2).image]


def test_a_defect_of_the_store_does_not_end_the_thread(store, opened):
    store.failure = ZeroDivisionError("a defect")
    inbox = opened()
    give(inbox, contribution(1))
    until(lambda: inbox.status().lost == 1, "it is given up")
    store.failure = None
    until(lambda: reason(give(inbox, contribution(2))) == "taken", "the inbox works again")
    until(lambda: inbox.status().written == 1, "it is written")


def test_a_photo_that_cannot_be_described_does_not_take_others_with_it(store, opened):
    store.gate = Gate()
    inbox = opened()
    give(inbox, contribution(0))
    assert store.gate.entered.acquire(timeout=WAIT_S)
    for i in (1, 2, 3):  # wait for the held write, and come in one batch
        place = inbox.reserve("Ada", 10)
        inbox.submit(place, (lambda: 1 / 0) if i == 2 else (lambda i=i: contribution(i)))
    store.gate.open()
    until(lambda: inbox.status().waiting == 0, "all are done")
    assert [c.image for c in store.written] == [contribution(i).image for i in (0, 1, 3)]
    status = inbox.status()
    assert (status.accepted, status.written, status.lost) == (4, 3, 1)


def test_a_photo_that_cannot_be_described_counts_against_nobody(store, opened):
    store.gate = Gate()
    inbox = opened(InboxOptions(max_owner_photos=2))
    give(inbox, contribution(0, "Bob"))
    assert store.gate.entered.acquire(timeout=WAIT_S)
    for make in (lambda: 1 / 0, lambda: contribution(1, "Ada")):  # in one batch
        inbox.submit(inbox.reserve("Ada", 10), make)
    store.gate.open()
    until(lambda: inbox.status().waiting == 0, "all are done")
    assert reason(give(inbox, contribution(2, "Ada"))) == "taken"


def test_a_store_that_cannot_be_counted_at_the_start(opened, store, monkeypatch):
    def fail() -> InboxCounts:
        raise StoreError("no such bucket")

    with monkeypatch.context() as broken:
        broken.setattr(store, "counts", fail)
        inbox = opened()
        refusal = give(inbox, contribution(1))
        assert reason(refusal) == "STORE_FAILED"
        assert "no such bucket" in refusal.detail
    until(lambda: reason(give(inbox, contribution(1))) == "taken", "the store is trusted again")


def test_a_closed_inbox_takes_nothing(store, opened):
    inbox = opened()
    inbox.close(WAIT_S)
    refusal = give(inbox, contribution(1))
    assert reason(refusal) == "STORE_FAILED"
    assert "stopping" in refusal.detail


def test_closing_does_not_wait_for_ever(store, opened):
    store.failure = StoreError("unreachable")
    inbox = opened(InboxOptions(retry_s=(60.0,)))
    give(inbox, contribution(1))
    until(lambda: store.attempts == 1, "it was tried")
    start = time.monotonic()
    inbox.close(WAIT_S)
    assert time.monotonic() - start < 5.0
    assert inbox.status().lost == 1


def test_what_a_stop_leaves_is_told_with_the_batch_in_hand(store, opened, caplog):
    store.gate = Gate()
    inbox = opened(InboxOptions(batch=1))
    give(inbox, contribution(1))
    until(lambda: store.attempts == 1, "the store has it in hand")
    give(inbox, contribution(2))
    inbox.close(0.1)
    (said,) = [record for record in caplog.records if "contributions lost" in record.message]
    assert said.fields["count"] == 2


def test_many_threads_give_at_once(store, opened):
    inbox = opened(InboxOptions(max_queue=1000))

    def run(owner: str) -> None:
        for i in range(50):
            assert reason(give(inbox, contribution(i, owner))) == "taken"

    threads = [threading.Thread(target=run, args=(f"owner {k}",)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(WAIT_S)
    inbox.close(WAIT_S)
    status = inbox.status()
    assert (status.accepted, status.written, status.waiting) == (200, 200, 0)
    assert len(store.written) == 200
