"""Columns of the tables come of the published JSON Schemas: who edits those changes what databases hold."""

import hashlib

import pytest

from featuredb.store.tables import BOUNDS, MAPS, NO_PLACE_COLUMNS, PLACE_COLUMNS, SPECS

# First digits of the SHA-256 of each Arrow schema as text. Another one is another format of the database:
# it needs a FORMAT_VERSION of its own and a way from the old one.
TYPES = {
    "maps": "f30295a75a816d0d",
    "images": "af7308493177d4db",
    "points": "72dd194c80f41013",
    "observations": "7f5610ed4611cfa1",
    "lidar": "9422118ec8e68a29",
    "lidar_points": "78bbb9cf5900b544",
    "candidates": "9f54598c723ad2d6",
    "candidate_images": "44bcade97d1227bc",
    "canaries": "5d32096e6997b9cc",
}


@pytest.mark.parametrize("table", SPECS)
def test_columns_are_those_of_the_format(table: str) -> None:
    assert hashlib.sha256(str(SPECS[table].schema).encode()).hexdigest()[:16] == TYPES[table]


def test_what_an_unplaced_map_lacks_is_what_may_be_null() -> None:
    nullable = [field.name for field in SPECS[MAPS].schema if field.nullable]
    assert sorted((*PLACE_COLUMNS, *BOUNDS, *NO_PLACE_COLUMNS)) == sorted(nullable)
