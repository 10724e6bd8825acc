"""Random maps through rows and back, bit for bit."""

import random
import tempfile
from datetime import UTC, datetime

import pyarrow as pa
from hypothesis import given, settings
from hypothesis import strategies as st

from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from featuredb.store.commits import new_write_id, write_time
from featuredb.store.decode import decode_map
from featuredb.store.encode import content_digest, encode_map, rows_table
from featuredb.store.verify import verify
from tests.support.maps import assert_same_map, random_map

maps = st.builds(
    random_map,
    st.integers(0, 2**32 - 1),
    map_id=st.text(min_size=1, max_size=20),
    points=st.integers(0, 40),
    images=st.integers(0, 5),
    observations=st.integers(0, 60),
    extent_m=st.sampled_from([0.0, 1.0, 3000.0]),
    parents=st.lists(st.text(max_size=5), max_size=3, unique=True).map(tuple),
)


@given(maps, st.randoms())
@settings(deadline=None, max_examples=40)
def test_rows_in_any_order_give_the_same_map(original: FeatureMap, shuffler: random.Random) -> None:
    encoded = encode_map(original, "0" * 32, datetime(2024, 1, 1, tzinfo=UTC))
    row = rows_table("maps", [encoded.row]).to_pylist()[0]
    children = {}
    for name, table in encoded.children.items():
        order = list(range(len(table)))
        shuffler.shuffle(order)
        children[name] = table.take(pa.array(order, pa.int64())).to_batches(max_chunksize=7)
    decoded = decode_map(row, children)
    assert_same_map(decoded, original)
    assert content_digest(decoded) == content_digest(original) == row["content_digest"]


@given(st.integers(0, 1000), st.integers(0, 1000))
@settings(deadline=None, max_examples=30)
def test_equal_digests_are_equal_maps(a: int, b: int) -> None:
    digests = [content_digest(random_map(seed, map_id="m", points=3, images=1)) for seed in (a, b)]
    assert (digests[0] == digests[1]) == (a == b)


def test_the_status_is_not_part_of_the_content() -> None:
    original = random_map(1)
    assert content_digest(original.with_status("quarantined")) == content_digest(original)


@given(st.datetimes(min_value=datetime(2000, 1, 1), max_value=datetime(2200, 1, 1), timezones=st.just(UTC)))
@settings(deadline=None)
def test_a_write_id_tells_its_time(now: datetime) -> None:
    write_id = new_write_id(now)
    assert len(write_id) == 32
    assert abs((write_time(write_id) - now).total_seconds()) <= 0.001
    assert new_write_id(now) != write_id


@given(st.lists(maps, min_size=1, max_size=3, unique_by=lambda m: m.map_id))
@settings(deadline=None, max_examples=5)
def test_through_a_database(originals: list[FeatureMap]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        database = Database.create(f"{folder}/maps.db")
        database.commit_maps(originals)
        snapshot = database.snapshot()
        for original in originals:
            assert_same_map(snapshot.load_map(original.map_id), original)
        assert verify(database).ok
