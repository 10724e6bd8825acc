"""Grouping of maps into areas: a partition by distance, extractor and height datum, across zone borders."""

from datetime import UTC, datetime

import numpy as np
import pyproj
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from featuredb.store import MapSummary
from featuredb.store.snapshot import UtmBox
from reloc.localiser import _group

HALF_M = 20.0
# Diagonals of the boxes below: maps join while their middles are closer than 300 m and two half diagonals.
REACH_M = 300.0 + 2 * np.sqrt(2) * HALF_M


def summary(
    name: str,
    easting: float,
    northing: float,
    *,
    half_m: float = HALF_M,
    epsg: int = 32632,
    kind: str = "x",
    datum: str = "unknown",
) -> MapSummary:
    return MapSummary(
        map_id=name,
        write_id=f"w-{name}",
        content_digest="",
        name=name,
        status="active",
        status_reason="",
        created_at=datetime(2024, 1, 1, tzinfo=UTC),
        epsg=epsg,
        height_datum=datum,
        box=UtmBox(
            min_easting=easting - half_m,
            max_easting=easting + half_m,
            min_northing=northing - half_m,
            max_northing=northing + half_m,
            min_height=100.0,
            max_height=100.0,
        ),
        tiles=(),
        images=3,
        points=10,
        observations=30,
        descriptors=30,
        method="gps",
        generation=0,
        parents=(),
        residual_rms_m=0.0,
        extractor_fingerprint=kind,
        source="",
        licence="",
    )


def names(groups: list[list[MapSummary]]) -> set[frozenset[str]]:
    return {frozenset(m.map_id for m in group) for group in groups}


def closure(maps: list[MapSummary]) -> set[frozenset[str]]:
    """Groups by merging sets until nothing changes; distances in UTM, all in one zone."""
    sets = [{m.map_id} for m in maps]
    by_name = {m.map_id: m for m in maps}

    def near(a: MapSummary, b: MapSummary) -> bool:
        assert a.box is not None
        assert b.box is not None
        middle = [
            (m.box.min_easting + m.box.max_easting, m.box.min_northing + m.box.max_northing) for m in (a, b)
        ]
        apart = 0.5 * np.hypot(middle[0][0] - middle[1][0], middle[0][1] - middle[1][1])
        halves = sum(0.5 * (m.box.max_easting - m.box.min_easting) for m in (a, b))
        same = (a.extractor_fingerprint, a.height_datum) == (b.extractor_fingerprint, b.height_datum)
        return bool(same and apart < 300.0 + np.sqrt(2) * halves)

    changed = True
    while changed:
        changed = False
        for i, one in enumerate(sets):
            for j in range(i + 1, len(sets)):
                if any(near(by_name[a], by_name[b]) for a in one for b in sets[j]):
                    one |= sets.pop(j)
                    changed = True
                    break
            if changed:
                break
    return {frozenset(s) for s in sets}


@settings(deadline=None, max_examples=50)
@given(
    st.lists(
        st.tuples(
            st.integers(0, 30),
            st.integers(0, 10),
            st.sampled_from("xy"),
            st.sampled_from(["unknown", "EGM96"]),
            st.sampled_from([5.0, HALF_M, 800.0]),
        ),
        max_size=14,
    )
)
def test_groups_are_the_closure_of_nearness(places: list[tuple[int, int, str, str, float]]) -> None:
    maps = [
        summary(
            f"m{i}", 500_000.0 + 100.0 * e, 5_400_000.0 + 100.0 * n, kind=kind, datum=datum, half_m=half_m
        )
        for i, (e, n, kind, datum, half_m) in enumerate(places)
    ]
    groups = _group(maps)
    assert sorted(m.map_id for g in groups for m in g) == sorted(m.map_id for m in maps)
    assert names(groups) == closure(maps)
    assert names(_group(maps[::-1])) == names(groups)


@pytest.mark.parametrize(("apart_m", "joined"), [(REACH_M - 2.0, True), (REACH_M + 2.0, False)])
def test_a_zone_border_between_them_does_not_matter(apart_m: float, joined: bool) -> None:
    """One map west of 12 degrees east in zone 32, one east of it in zone 33, a known geodesic apart."""
    geod = pyproj.Geod(ellps="WGS84")
    lat = 50.0
    west_lon, west_lat, _ = geod.fwd(12.0, lat, 270.0, apart_m / 2)
    east_lon, east_lat, _ = geod.fwd(12.0, lat, 90.0, apart_m / 2)
    west = summary("west", *pyproj.Transformer.from_crs(4326, 32632).transform(west_lat, west_lon))
    east = summary(
        "east", *pyproj.Transformer.from_crs(4326, 32633).transform(east_lat, east_lon), epsg=32633
    )
    expected = {frozenset({"west", "east"})} if joined else {frozenset({"west"}), frozenset({"east"})}
    assert names(_group([west, east])) == expected


def test_the_same_numbers_in_another_zone_are_another_place() -> None:
    maps = [summary("a", 500_000.0, 5_400_000.0), summary("b", 500_000.0, 5_400_000.0, epsg=32733)]
    assert len(_group(maps)) == 2


def test_no_maps_no_groups() -> None:
    assert _group([]) == []
