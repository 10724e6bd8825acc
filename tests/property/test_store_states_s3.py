"""A database in an object store whose requests fail: refused, cut off, or done and never answered."""

from collections.abc import Iterator
from contextlib import suppress
from importlib.util import find_spec

import pytest

from featuredb.errors import StoreError
from featuredb.store import Database
from featuredb.store.tables import CANDIDATES
from featuredb.store.verify import verify
from tests.support.s3_faults import KINDS, LOST, REFUSED, RETRIED, Fault, FaultyStore, faulty_store
from tests.support.s3_server import BUCKET, moto_server
from tests.support.store_machine import ObjectStoreMachine, run, seen, small_map

pytestmark = pytest.mark.s3
ENTRY = "/maps/_delta_log/0"


@pytest.fixture(scope="module")
def store() -> Iterator[FaultyStore]:
    if find_spec("moto") is None or find_spec("flask") is None:
        pytest.skip("moto is not installed: pip install 'moto[server]'")
    with moto_server() as options, faulty_store(options) as found:
        yield found


@pytest.fixture
def database(store: FaultyStore, request: pytest.FixtureRequest) -> Database:
    name = "".join(filter(str.isalnum, request.node.name))
    made = Database.create(f"s3://{BUCKET}/{name}.db", storage_options=store.options)
    made.commit_map(small_map("map-1", 1))
    return made


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.evaluation) if kind == "500" else kind for kind in REFUSED]
)
def test_a_commit_whose_entry_is_refused_is_not_there(
    store: FaultyStore, database: Database, kind: str
) -> None:
    before = seen(database)
    with store.failing(Fault(kind=kind, count=RETRIED, path=ENTRY)), pytest.raises(StoreError) as error:
        database.commit_map(small_map("map-3", 3))
    assert type(error.value) is StoreError
    assert store.injected
    assert seen(database) == before
    assert database.commit_map(small_map("map-3", 3)).created
    assert seen(database).keys() == {"map-1", "map-3"}
    assert verify(database).problems == ()


@pytest.mark.parametrize("kind", LOST)
def test_an_entry_that_was_taken_is_known_for_ones_own(
    store: FaultyStore, database: Database, kind: str
) -> None:
    """The client asks again and finds it there, as if another one had written it, or gives up."""
    version, fault = database.poll_version(), Fault(kind=kind, count=1, path=ENTRY)
    with store.failing(fault):
        assert database.commit_map(small_map("map-3", 3)).created
    assert store.injected == 1
    with store.failing(fault):
        assert database.retire("map-1", "wrong") == ("map-1",)
    with store.failing(fault):
        assert database.rollback(version) == version + 3
    assert database.poll_version() == version + 3
    assert seen(database).keys() == {"map-1"}
    assert verify(database).problems == ()


@pytest.mark.parametrize(
    "first",
    [0, pytest.param(5, marks=pytest.mark.evaluation), 12, pytest.param(20, marks=pytest.mark.evaluation)],
)
def test_a_store_that_does_not_answer_is_not_damaged(
    store: FaultyStore, database: Database, first: int
) -> None:
    for kind in ("503", "torn answer"):
        with store.failing(Fault(kind=kind, first=first, count=1000, writes=False)):
            for ask in (
                verify,
                lambda d: d.has(CANDIDATES),
                lambda d: d.snapshot(0),
                lambda d: Database.open(d.url, storage_options=d.storage_options),
            ):
                with pytest.raises(StoreError) as error:
                    ask(database)
                assert type(error.value) is StoreError
    with store.failing(Fault(kind="503", first=first, count=RETRIED, writes=False)), suppress(StoreError):
        assert verify(database).problems == ()


@pytest.mark.evaluation
@pytest.mark.timeout(7200)
def test_a_thousand_steps(store: FaultyStore) -> None:
    ObjectStoreMachine.store = store
    ObjectStoreMachine.faults.clear()
    run(ObjectStoreMachine, 60, 22)
    assert ObjectStoreMachine.steps >= 1000
    assert ObjectStoreMachine.kills > 100
    assert ObjectStoreMachine.faults.keys() == set(KINDS)
