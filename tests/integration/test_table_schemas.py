"""The published JSON Schemas are those of the real tables."""

import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from deltalake import DeltaTable

from featuredb.lidar.add import add_scan
from featuredb.store import Database
from featuredb.store.canaries import add_canary
from featuredb.store.candidates.photos import contribute, mark_used, refuse
from featuredb.store.tables import SPECS
from schemas import load_schema, schema_names
from tests.support.contributions import contribution, known_pose
from tests.support.las_files import grid_points, write_scan
from tests.support.maps import random_map, random_unplaced_map

TABLES = tuple(SPECS)


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Database:
    database = Database.create(tmp_path_factory.mktemp("schemas") / "maps.db")
    database.commit_map(random_map(1))
    database.commit_map(random_map(2, points=0, images=0, parents=("map-1",)))
    database.retire("map-1", "test")
    database.commit_map(random_unplaced_map(3))
    folder = tmp_path_factory.mktemp("scans")
    add_scan(database, [write_scan(folder / "a.laz", grid_points(200), red=np.full(200, 9))])
    add_scan(database, [write_scan(folder / "b.laz", grid_points(200), point_format=6)])
    ids = contribute(database, [contribution(1), contribution(2)])
    mark_used(database, ids[:1], "map-2")
    refuse(database, {ids[1]: ("NO_OVERLAP", "shares nothing with any other photo")})
    add_canary(database, "gate", b"photo", known_pose(), origin="answer", snapshot=1)
    add_canary(database, "other town", b"elsewhere", None, origin="person")
    return database


def as_json(value: Any) -> Any:
    """A row as the schemas describe it: bytes in hexadecimal, times in ISO 8601."""
    return json.loads(json.dumps(value, default=lambda v: v.hex() if isinstance(v, bytes) else v.isoformat()))


def test_every_table_has_a_schema_and_every_schema_a_table() -> None:
    assert {name for name in schema_names() if name.startswith("tables/")} == {f"tables/{t}" for t in TABLES}
    with pytest.raises(KeyError, match="tables/maps"):
        load_schema("tables/nothing")


@pytest.mark.parametrize("table", TABLES)
def test_columns_types_and_partitions(database: Database, table: str) -> None:
    schema = load_schema(f"tables/{table}")
    jsonschema.Draft202012Validator.check_schema(schema)
    real = DeltaTable(f"{database.url}/{table}")
    columns = {field["name"]: field for field in json.loads(real.schema().to_json())["fields"]}
    assert list(schema["properties"]) == list(columns) == schema["required"]
    assert schema["x-partition-by"] == real.metadata().partition_columns
    for name, field in columns.items():
        published = schema["properties"][name]
        assert published["description"]
        assert ("null" in published["type"]) == field["nullable"], name
        if isinstance(field["type"], str):
            assert published["x-delta-type"] == field["type"], name
        else:
            assert "array" in published["type"], name


@pytest.mark.parametrize("table", TABLES)
def test_real_rows_fit(database: Database, table: str) -> None:
    validator = jsonschema.Draft202012Validator(load_schema(f"tables/{table}"))
    rows = as_json(DeltaTable(f"{database.url}/{table}").to_pyarrow_table().to_pylist())
    assert rows
    for row in rows:
        validator.validate(row)
    for name in rows[0]:
        wrong = {k: v for k, v in rows[0].items() if k != name}
        assert not validator.is_valid(wrong), name
        assert not validator.is_valid({**rows[0], name: {"no": "such"}}), name


def test_schemas_are_formatted() -> None:
    for path in Path(__file__).parents[2].glob("schemas/tables/*.json"):
        assert path.read_text() == json.dumps(json.loads(path.read_text()), indent=2) + "\n"
