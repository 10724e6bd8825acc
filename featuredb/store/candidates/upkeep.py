"""What `verify` looks at in contributed photos and known queries."""

import hashlib
from collections.abc import Iterator

import pyarrow as pa

from featuredb.errors import FeatureDbError
from featuredb.store.canaries import list_canaries, load_canary_image
from featuredb.store.candidates.photos import by_candidate, live_maps, read_events
from featuredb.store.candidates.states import CONTRIBUTED, EVENTS, standing_of
from featuredb.store.database import Database
from featuredb.store.durable.filesystem import one_line
from featuredb.store.tables import CANARIES, CANDIDATE_IMAGES, CANDIDATES

_GROWTH = (CANDIDATES, CANDIDATE_IMAGES, CANARIES)


def check_growth_tables(database: Database) -> list[tuple[str, str]]:
    """What is wrong with contributed photos and known queries: where, and what. Reads every image.

    Where others commit meanwhile, as a withdrawal does, it looks again for what it has found.
    """

    def look() -> tuple[list[int], list[tuple[str, str]]]:
        return versions(), [*_check_candidates(database), *_check_canaries(database)]

    def versions() -> list[int]:
        return [database.table(name).version for name in database.tables() if name in _GROWTH]

    seen, found = look()
    while found and seen != versions():
        seen, again = look()
        lasting = [problem for problem in found if problem in again]
        if lasting == found:
            break
        found = lasting
    return found


def _check_candidates(database: Database) -> Iterator[tuple[str, str]]:
    if not database.has(CANDIDATES):
        return
    try:
        events = read_events(database)
        live = live_maps(database)
        digests = dict(_stored_digests(database))
    except (FeatureDbError, OSError, pa.ArrowException) as error:
        yield "candidates", f"cannot be read: {one_line(error)[:300]}"
        return
    whole = by_candidate(events)
    for event in events:
        where = f"candidate {event['candidate_id']}"
        if event["event"] not in EVENTS:
            yield where, f"an event {event['event']!r} that is none of {', '.join(EVENTS)}"
        elif event["candidate_id"] not in whole:
            yield where, f"an event {event['event']!r} of a photo that nobody contributed"
    for candidate_id, own in whole.items():
        where, state = f"candidate {candidate_id}", standing_of(own, live).state
        expected = next(e["sha256"] for e in own if e["event"] == CONTRIBUTED)
        if not str(expected).startswith(candidate_id):
            yield where, f"its id is not the beginning of its hash {expected}"
        if candidate_id not in digests:
            if state in ("waiting", "used"):
                yield where, f"it is {state}, but its image is not there"
        elif state == "withdrawn":
            yield where, "it is withdrawn, but its image is still there; withdraw it again"
        elif digests[candidate_id] != expected:
            yield where, "its image is not the one that was contributed: hashes differ"


def _check_canaries(database: Database) -> Iterator[tuple[str, str]]:
    try:
        canaries = list_canaries(database)
    except FeatureDbError as error:
        yield "canaries", f"cannot be read: {error}"
        return
    names = [canary.name for canary in canaries]
    for name in sorted({name for name in names if names.count(name) > 1}):
        yield f"canary {name}", "there are several of this name"
    for canary in canaries:
        try:
            load_canary_image(database, canary)
        except FeatureDbError as error:
            yield f"canary {canary.name}", str(error)


def _stored_digests(database: Database) -> Iterator[tuple[str, str]]:
    """Candidate and SHA-256 of each stored image, one in memory at a time."""
    dataset = database.table(CANDIDATE_IMAGES).dataset()
    batches = dataset.to_batches(
        columns=["candidate_id", "image"],
        batch_size=1,
        batch_readahead=1,
        fragment_readahead=1,
        use_threads=False,
    )
    for batch in batches:
        for candidate_id, image in zip(batch["candidate_id"], batch["image"], strict=True):
            yield candidate_id.as_py(), hashlib.sha256(image.as_buffer()).hexdigest()
