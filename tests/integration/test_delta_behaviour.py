"""What the store relies on in deltalake; if one of these fails, read featuredb/store/delta.py again."""

from pathlib import Path

import pyarrow as pa
import pyarrow.dataset as ds
import pytest
from deltalake import CommitProperties, DeltaTable, write_deltalake
from deltalake.exceptions import CommitFailedError

SWAP = CommitProperties(max_commit_retries=0)


def rows(*values: int) -> pa.Table:
    return pa.table({"a": pa.array(values, pa.int64())})


@pytest.fixture
def url(tmp_path: Path) -> str:
    DeltaTable.create(tmp_path / "t", rows().schema)
    return str(tmp_path / "t")


def values(url: str) -> list[int]:
    return sorted(DeltaTable(url).to_pyarrow_table()["a"].to_pylist())


def test_appends_from_stale_tables_all_land(url: str) -> None:
    first, second = DeltaTable(url), DeltaTable(url)
    write_deltalake(first, rows(1), mode="append")
    write_deltalake(second, rows(2), mode="append")
    assert values(url) == [1, 2]


@pytest.mark.parametrize("mode", ["append", "overwrite"])
def test_without_retries_a_commit_is_a_compare_and_swap(url: str, mode: str) -> None:
    stale = DeltaTable(url)
    write_deltalake(DeltaTable(url), rows(1), mode="append")
    with pytest.raises(CommitFailedError):
        write_deltalake(stale, rows(2), mode=mode, commit_properties=SWAP)
    assert values(url) == [1]
    fresh = DeltaTable(url)
    write_deltalake(fresh, rows(2), mode=mode, commit_properties=SWAP)
    assert fresh.version() == 2
    assert values(url) == ([1, 2] if mode == "append" else [2])


def test_with_retries_an_overwrite_does_not_notice_an_append(url: str) -> None:
    """The reason why `maps` is never overwritten that way."""
    stale = DeltaTable(url)
    write_deltalake(DeltaTable(url), rows(1), mode="append")
    write_deltalake(stale, rows(2), mode="overwrite")
    assert values(url) == [1, 2]


def test_a_delete_writes_types_that_cannot_be_filtered_and_an_overwrite_does_not(tmp_path: Path) -> None:
    """The reason why rows are removed by an overwrite with a predicate."""
    names = pa.table({"a": ["x", "y", "z"]})
    for how in ("delete", "overwrite"):
        url = str(tmp_path / how)
        write_deltalake(url, names)
        if how == "delete":
            DeltaTable(url).delete("a IN ('x')")
            with pytest.raises(pa.ArrowNotImplementedError, match="string_view"):
                DeltaTable(url).to_pyarrow_dataset().to_table(filter=ds.field("a") == "y")
        else:
            write_deltalake(url, names.schema.empty_table(), mode="overwrite", predicate="a IN ('x')")
            found = DeltaTable(url).to_pyarrow_dataset().to_table(filter=ds.field("a") == "y")
            assert found.to_pydict() == {"a": ["y"]}
            assert len(DeltaTable(url).to_pyarrow_table()) == 2


def test_compaction_does_not_hinder_appends(url: str) -> None:
    for value in (1, 2):
        write_deltalake(url, rows(value), mode="append")
    stale = DeltaTable(url)
    write_deltalake(url, rows(3), mode="append")
    stale.optimize.compact()
    assert values(url) == [1, 2, 3]
