"""Which maps are exported, and what licences leave of them."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from featuredb.errors import ExportError, MapNotFoundError, StoreError
from featuredb.export.selection import (
    Selection,
    exported,
    licence_is,
    licensed,
    selected_maps,
    touches,
)
from featuredb.geo.utm import geodetic_from_utm
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from tests.support.maps import EPSG, random_map


@pytest.fixture
def database(tmp_path: Path) -> Database:
    database = Database.create(tmp_path / "db")
    database.commit_map(random_map(1, map_id="one"))
    database.commit_map(random_map(2, map_id="two", images=6))
    database.commit_map(random_map(3, map_id="three", images=5).with_status("quarantined"))
    return database


def ids(database: Database, selection: Selection) -> list[str]:
    return [m.map_id for m in selected_maps(database, database.snapshot(), selection)]


def mixed() -> FeatureMap:
    """Four photos: CC BY, CC BY-SA, CC0 by the map, and CC BY again."""
    whole = random_map(4)
    licences = ("CC BY 4.0", "CC-BY-SA-4.0", "", "cc_by")
    images = tuple(replace(i, licence=name) for i, name in zip(whole.images, licences, strict=True))
    return replace(whole, images=images)


def test_by_status_and_by_id(database: Database) -> None:
    assert ids(database, Selection()) == ["one", "two"]
    assert ids(database, Selection(statuses=("quarantined",))) == ["three"]
    assert ids(database, Selection(maps=("three", "one"))) == ["one", "three"]
    assert ids(database, Selection(maps=("th", "o"))) == ["one", "three"]
    with pytest.raises(MapNotFoundError, match="four"):
        ids(database, Selection(maps=("four",)))
    database.retire("one", "test")
    database.retire("two", "test")
    with pytest.raises(ExportError, match="expected maps that are active, found none"):
        ids(database, Selection())


def test_by_sql(database: Database) -> None:
    assert ids(database, Selection(where="images > 5 -- many")) == ["two"]
    with pytest.raises(ExportError, match="maps with images > 50"):
        ids(database, Selection(where="images > 50"))
    with pytest.raises(StoreError, match="no_such_column"):
        ids(database, Selection(where="no_such_column > 50"))


@pytest.mark.parametrize(
    ("west", "east", "found"),
    [(-0.01, 0.01, True), (0.1, 0.2, False), (-0.1, -0.2, True), (0.2, 0.1, False)],
)
def test_by_place(database: Database, west: float, east: float, found: bool) -> None:
    """Degrees beside a corner of the maps; the third box goes nearly all around the Earth, to the east."""
    box = database.snapshot().get("one").box
    assert box is not None
    latitude, longitude, _ = geodetic_from_utm([[box.min_easting, box.min_northing, 0.0]], EPSG)[0]
    if (west, east) == (0.2, 0.1):  # across the antimeridian to a place west of the maps
        east = -0.1
    selection = Selection(bbox=(longitude + west, latitude - 1, longitude + east, latitude + 1))
    if found:
        assert ids(database, selection) == ["one", "two"]
    else:
        with pytest.raises(ExportError, match=r"expected maps in .* found none"):
            ids(database, selection)


def test_a_map_across_the_antimeridian_does_not_go_around_the_earth() -> None:
    box = SimpleNamespace(
        min_easting=800_000.0, max_easting=840_000.0, min_northing=8_100_000.0, max_northing=8_110_000.0
    )
    fiji: Any = SimpleNamespace(box=box, epsg=32760)
    for west, east, met in (
        (179.8, 180.0, True),
        (-180.0, -179.9, True),
        (179.0, -179.0, True),
        (8.0, 9.0, False),
    ):
        assert touches(fiji, (west, -20.0, east, -10.0)) == met, (west, east)


def test_a_box_is_one() -> None:
    with pytest.raises(ExportError, match="south < north, found 1,3,2,2"):
        Selection(bbox=(1.0, 3.0, 2.0, 2.0))


@pytest.mark.parametrize(
    ("licence", "wanted", "same"),
    [
        ("CC-BY-4.0", "cc-by", True),
        ("CC BY 4.0", "cc-by-4.0", True),
        ("CC-BY-3.0", "cc-by-4.0", False),
        ("CC-BY-SA-4.0", "cc-by", False),
        ("CC-BY-NC-ND 2.0", "cc-by-nc", False),
        ("CC0-1.0", "cc0", True),
        ("CC0", "cc0", True),
        ("", "cc0", False),
        ("all rights reserved", "cc-by", False),
    ],
)
def test_licences_are_compared_as_people_write_them(licence: str, wanted: str, same: bool) -> None:
    assert licence_is(licence, wanted) is same


def test_photos_of_other_licences_leave_nothing_behind() -> None:
    whole = mixed()
    part = licensed(whole, ("cc-by", "cc0"))
    assert part is not None
    assert [i.image_id for i in part.images] == [0, 2, 3]
    assert 1 not in part.observations.image_id
    assert len(part.points) < len(whole.points)
    assert part.provenance["exported_by_licence"] == {"licences": ["cc-by", "cc0"], "photos_left_out": 1}
    assert licensed(whole, None) is whole
    assert licensed(whole, ("cc-by", "cc0", "cc-by-sa")) is whole
    assert licensed(whole, ("mit",)) is None


def test_maps_come_one_by_one_and_never_none_at_all(database: Database) -> None:
    snapshot = database.snapshot()
    maps = selected_maps(database, snapshot, Selection())
    assert [m.map_id for m in exported(snapshot, maps, None)] == ["one", "two"]
    with pytest.raises(ExportError, match="expected photos with a licence of mit, found none"):
        list(exported(snapshot, maps, ("mit",)))
