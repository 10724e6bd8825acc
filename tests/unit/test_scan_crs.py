"""The coordinate system of scans, against pyproj used directly and closed forms."""

import numpy as np
import pytest
from pyproj import CRS, Transformer

from featuredb.errors import FeatureDbError, GeodesyError
from featuredb.geo.crs.geotiff_keys import crs_of_geo_keys
from featuredb.geo.crs.scan import FOOT_M, US_SURVEY_FOOT_M, ScanCrs, scan_crs
from featuredb.geo.crs.utm_transform import utm_transform
from featuredb.geo.utm import utm_from_geodetic

# Oregon's Lambert conformal conic on NAD83(HARN) in international feet, as the Autzen scan has it, user-
# defined.
OREGON_FEET = (
    'PROJCS["NAD_1983_HARN_Lambert_Conformal_Conic",GEOGCS["GCS_North_American_1983_HARN",'
    'DATUM["NAD83_High_Accuracy_Regional_Network",SPHEROID["GRS_1980",6378137,298.257222101,'
    'AUTHORITY["EPSG","7019"]],AUTHORITY["EPSG","6152"]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433]],PROJECTION["Lambert_Conformal_Conic_2SP"],'
    'PARAMETER["standard_parallel_1",43],PARAMETER["standard_parallel_2",45.5],'
    'PARAMETER["latitude_of_origin",41.75],PARAMETER["central_meridian",-120.5],'
    'PARAMETER["false_easting",1312335.958005249],PARAMETER["false_northing",0],'
    'UNIT["foot",0.3048,AUTHORITY["EPSG","9002"]]]'
)
OREGON_KEYS: dict[int, int | float | str] = {
    1024: 1, 1026: "NAD_1983_HARN_Lambert_Conformal_Conic|", 2048: 32767, 2050: 6152, 3072: 32767, 3074:
        32767,
    3075: 8, 3076: 9002, 3078: 43.0, 3079: 45.5, 3084: -120.5, 3085: 41.75, 3086: 1312335.958005249, 3087:
        0.0,
}  # fmt: skip
STADIUM = np.array([[637_450.0, 851_900.0, 420.0], [637_460.0, 851_950.0, 598.0]])


def to_utm(crs: ScanCrs, xyz: np.ndarray) -> tuple[np.ndarray, int]:
    transform = utm_transform(crs, xyz.min(axis=0), xyz.max(axis=0))
    return transform.apply(xyz), transform.epsg


def test_feet_without_a_vertical_crs_are_feet_in_height_too() -> None:
    crs = scan_crs(wkt=OREGON_FEET)
    assert (crs.horizontal_unit, crs.height_unit, crs.height_unit_m) == ("foot", "foot", FOOT_M)
    assert "--height-unit" in crs.height_unit_reason
    assert crs.height_datum == "unknown"
    utm, epsg = to_utm(crs, STADIUM)
    assert epsg == 32610
    np.testing.assert_allclose(utm[:, 2], STADIUM[:, 2] * 0.3048, atol=1e-9)
    # The stadium stands at 44.0583 N, 123.0685 W.
    np.testing.assert_allclose(
        utm[0, :2], utm_from_geodetic([44.0583, -123.0685, 0.0], 32610)[:2], atol=150.0
    )
    expected = Transformer.from_crs(OREGON_FEET, 32610, always_xy=True).transform(*STADIUM[:, :2].T)
    np.testing.assert_allclose(utm[:, :2], np.transpose(expected), atol=2.0)  # datum shifts differ by metres


def test_the_height_unit_can_be_stated() -> None:
    utm, _ = to_utm(scan_crs(wkt=OREGON_FEET, height_unit="m"), STADIUM)
    np.testing.assert_allclose(utm[:, 2], STADIUM[:, 2], atol=1e-9)
    utm, _ = to_utm(scan_crs(override="EPSG:32610", height_unit="us-ft"), np.array([[5e5, 4.9e6, 3937.0]]))
    np.testing.assert_allclose(utm[:, 2], 1200.0, atol=1e-9)
    with pytest.raises(GeodesyError, match="--height-unit"):
        scan_crs(wkt=OREGON_FEET, height_unit="fathom")


def test_us_survey_feet_are_not_international_feet() -> None:
    crs = scan_crs(override="EPSG:2227")  # California zone 3
    assert crs.horizontal_unit == "US survey foot"
    assert crs.height_unit_m == pytest.approx(US_SURVEY_FOOT_M, rel=1e-12)
    point = np.array([[6_050_000.0, 2_110_000.0, 100.0]])
    utm, epsg = to_utm(crs, point)
    metres = Transformer.from_crs("EPSG:26943", epsg, always_xy=True)  # the same zone in metres
    expected = metres.transform(point[0, 0] * US_SURVEY_FOOT_M, point[0, 1] * US_SURVEY_FOOT_M)
    np.testing.assert_allclose(utm[0, :2], expected, atol=0.05)
    wrong = metres.transform(point[0, 0] * FOOT_M, point[0, 1] * FOOT_M)
    assert np.hypot(*(utm[0, :2] - wrong)) > 3.5  # two parts in a million of 1,840 km


@pytest.mark.parametrize(
    ("code", "datum", "unit_m"),
    [
        ("EPSG:6556+6360", "navd88", US_SURVEY_FOOT_M),
        ("EPSG:6556+5703", "navd88", 1.0),
        ("EPSG:6557+8228", "navd88", FOOT_M),
        ("EPSG:32632+5773", "egm96", 1.0),
        ("EPSG:32632+3855", "egm2008", 1.0),
        ("EPSG:3005+5713", "unknown", 1.0),  # CGVD28
    ],
)
def test_compound_systems(code: str, datum: str, unit_m: float) -> None:
    for crs in (scan_crs(override=code), scan_crs(wkt=CRS.from_user_input(code).to_wkt("WKT1_GDAL"))):
        assert crs.height_datum == datum
        assert crs.height_unit_m == pytest.approx(unit_m, rel=1e-9)
        assert crs.vertical_name
        assert not crs.is_3d


def test_a_bound_compound_is_refused_since_its_heights_would_pass_for_ellipsoidal() -> None:
    source = CRS.from_user_input("EPSG:25832+7837")
    shift = (
        'ABRIDGEDTRANSFORMATION["shift",METHOD["Geocentric translations (geog3D domain)",ID["EPSG",1035]],'
        'PARAMETER["X-axis translation",0],PARAMETER["Y-axis translation",0],'
        'PARAMETER["Z-axis translation",0]]'
    )
    target = CRS.from_epsg(4979).to_wkt()
    wkt = f"BOUNDCRS[SOURCECRS[{source.to_wkt()}],TARGETCRS[{target}],{shift}]"
    assert CRS.from_wkt(wkt).is_vertical
    with pytest.raises(GeodesyError, match="expected a projected"):
        scan_crs(wkt=wkt)


def test_a_stated_datum_wins_and_a_contradiction_is_told() -> None:
    crs = scan_crs(override="EPSG:6556+5703", height_datum="egm96")
    assert crs.height_datum == "egm96"
    assert "navd88" in crs.notes[0]
    assert scan_crs(wkt=OREGON_FEET, height_datum="navd88").notes == ()
    with pytest.raises(FeatureDbError, match="unknown"):
        scan_crs(wkt=OREGON_FEET, height_datum="sea level")


def test_degrees_are_longitude_before_latitude_whatever_the_definition_says() -> None:
    places = np.array([[9.1, 45.1, 100.0], [9.2, 45.2, 110.0]])
    utm, epsg = to_utm(scan_crs(override="EPSG:4326"), places)
    assert epsg == 32632
    np.testing.assert_allclose(utm, utm_from_geodetic(places[:, [1, 0, 2]], 32632), atol=1e-6)
    northing_first = scan_crs(override="EPSG:2326")  # Hong Kong 1980 Grid: northing, easting
    utm, epsg = to_utm(northing_first, np.array([[836_694.05, 819_069.80, 0.0]]))  # its origin
    assert epsg == 32650 or epsg == 32649
    expected = utm_from_geodetic([22.3121 - 0.0015, 114.1786 + 0.0024, 0.0], epsg)[:2]
    np.testing.assert_allclose(utm[0, :2], expected, atol=60.0)


def test_heights_of_three_dimensional_systems_go_to_the_ellipsoid() -> None:
    place = np.array([[46.0, 8.5, 1234.5]])
    geocentric = Transformer.from_crs(4979, 4978).transform(*place[0])
    crs = scan_crs(override="EPSG:4978")
    assert crs.is_3d
    assert crs.height_datum == "ellipsoidal"
    utm, epsg = to_utm(crs, np.array([geocentric]))
    np.testing.assert_allclose(utm, utm_from_geodetic(place, epsg), atol=1e-6)
    crs = scan_crs(override="EPSG:4979")
    np.testing.assert_allclose(to_utm(crs, place[:, [1, 0, 2]])[0], utm, atol=1e-6)
    with pytest.raises(GeodesyError, match="third axis"):
        scan_crs(override="EPSG:4979", height_datum="navd88")


def test_utm_stays_as_it_is() -> None:
    points = np.array([[576_662.123, 5_188_114.456, 156.0]])
    transform = utm_transform(scan_crs(override="EPSG:32615"), points[0], points[0])
    assert transform.epsg == 32615
    np.testing.assert_array_equal(transform.apply(points), points)


def test_the_zone_is_that_of_the_centre_or_the_one_asked_for() -> None:
    crs = scan_crs(override="EPSG:32632")
    beside = np.array([[120_000.0, 5_000_000.0, 0.0]])  # at 4.2 degrees east: zone 31
    utm, epsg = to_utm(crs, beside)
    assert epsg == 32631
    expected = Transformer.from_crs(32632, 32631, always_xy=True).transform(120_000.0, 5_000_000.0)
    np.testing.assert_allclose(utm[0, :2], expected, atol=1e-3)
    kept = utm_transform(crs, beside[0], beside[0], epsg=32632)
    np.testing.assert_array_equal(kept.apply(beside), beside)


def test_across_the_antimeridian() -> None:
    fiji = np.array([[179.9, -16.8, 0.0], [-179.98, -16.7, 0.0]])
    transform = utm_transform(scan_crs(override="EPSG:4326"), np.array([-179.98, -16.8, 0]), fiji[0])
    assert transform.epsg == 32760
    assert np.isfinite(transform.apply(fiji)).all()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "found none; state .* --crs"),
        ({"wkt": "  "}, "found none"),
        ({"wkt": "PROJCS[broken"}, "WKT is not readable"),
        ({"wkt": 'LOCAL_CS["unnamed",UNIT["metre",1]]'}, "no place on Earth"),
        ({"override": "EPSG:99999"}, "--crs"),
        ({"override": "EPSG:5703"}, "no place on Earth"),
        ({"override": "EPSG:32632+5706"}, "depths downwards"),
        ({"override": "EPSG:2053"}, "counts towards"),
        ({"geo_keys": {1024: 1}}, "name no CRS"),
        ({"geo_keys": {3072: 32767, 3075: 27}}, "not understood"),
        ({"geo_keys": {3072: 2949, 3076: 9002}}, "contradict"),
        ({"geo_keys": {3072: 31}}, "make no CRS"),
    ],
)
def test_what_names_no_place_is_refused(given: dict[str, object], message: str) -> None:
    with pytest.raises(GeodesyError, match=message):
        scan_crs(**given)  # type: ignore[arg-type]


def test_coordinates_that_contradict_the_system_are_refused() -> None:
    geocentric = scan_crs(override="EPSG:4978")
    with pytest.raises(GeodesyError, match="4,945 km from the Earth's centre"):
        utm_transform(
            geocentric,
            np.array([515_368.0, 4_918_340.0, 2_322.0]),
            np.array([515_401.0, 4_918_381.0, 2338.0]),
        )
    elsewhere = np.array([5_000_000.0, 851_900.0, 0.0])  # metres of another country
    with pytest.raises(GeodesyError, match="outside the area"):
        utm_transform(scan_crs(override="EPSG:2949"), elsewhere, elsewhere)
    with pytest.raises(GeodesyError, match="--crs"):
        utm_transform(
            scan_crs(override="EPSG:4326"), np.array([500_000.0, 5e6, 0.0]), np.array([500_001.0, 5e6, 0.0])
        )


def test_keys_that_define_a_projection_make_that_of_the_wkt() -> None:
    by_keys = scan_crs(geo_keys=OREGON_KEYS)
    assert (by_keys.horizontal_unit, by_keys.source) == ("foot", "GeoTIFF keys")
    np.testing.assert_allclose(
        to_utm(by_keys, STADIUM)[0], to_utm(scan_crs(wkt=OREGON_FEET), STADIUM)[0], atol=1e-4
    )


def test_keys_of_the_other_projections() -> None:
    albers = crs_of_geo_keys(
        {3072: 32767, 2048: 4269, 3075: 11, 3076: 9001, 3078: 50.0, 3079: 58.5, 3080: -126.0, 3081: 45.0,
         3082: 1_000_000.0, 3083: 0.0}, ""
    )  # fmt: skip
    mercator = crs_of_geo_keys(
        {
            3072: 32767,
            2048: 4326,
            3075: 1,
            3076: 9001,
            3080: 9.0,
            3081: 0.0,
            3082: 500_000.0,
            3083: 0.0,
            3092: 0.9996,
        },
        "",
    )
    for made, code, point in (
        (albers, 3005, (885_022.0, 629_157.0)),
        (mercator, 32632, (512_345.0, 5_012_345.0)),
    ):
        geographic = made.geodetic_crs
        ours = Transformer.from_crs(made, geographic, always_xy=True).transform(*point)
        theirs = Transformer.from_crs(code, geographic, always_xy=True).transform(*point)
        np.testing.assert_allclose(ours, theirs, atol=1e-10)


def test_keys_with_heights() -> None:
    assert scan_crs(geo_keys={3072: 3005, 4096: 5713}).vertical_name.startswith("CGVD28")
    assert (
        scan_crs(geo_keys={3072: 6556, 4096: 5103}).height_datum == "navd88"
    )  # the datum's code for the CRS's
    in_feet = scan_crs(geo_keys={3072: 2949, 4099: 9003})
    assert in_feet.height_unit_m == pytest.approx(US_SURVEY_FOOT_M)


def test_points_outside_the_projection_are_an_error_and_not_infinite() -> None:
    crs = scan_crs(override="EPSG:2949")
    transform = utm_transform(
        crs, np.array([273_357.0, 5_274_357.0, 789.0]), np.array([273_642.0, 5_274_642.0, 829.0])
    )
    with pytest.raises(GeodesyError, match="cannot express"):
        transform.apply(np.array([[1e9, 1e9, 0.0]]))
