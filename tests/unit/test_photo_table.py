"""Tables of photos: every form gives the same rows, and what is wrong is told by row."""

import json
from datetime import UTC, datetime
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import ExifTags, Image

from featuredb.errors import IngestError
from featuredb.features.exif.write import gps_directory
from ingest.photos.scan import ScanOptions, require_photos, scan_table
from ingest.photos.table import is_table, read_table, summary_of

_ROWS = [
    {"path": "a/one.jpg", "lat": 48.99, "lon": 8.41, "accuracy": 25.0, "time": "2026-03-01T12:00:00+00:00",
     "owner": "Ann", "licence": "CC-BY-4.0", "title": "Église, été", "views": 7},
    {"path": "two.jpg", "lat": None, "lon": None, "accuracy": None, "time": None, "owner": None,
     "licence": None, "title": None, "views": None},
]  # fmt: skip


def _written(folder: Path, suffix: str) -> Path:
    path = folder / f"photos{suffix}"
    if suffix == ".parquet":
        pq.write_table(pa.Table.from_pylist(_ROWS), path)
    elif suffix == ".jsonl":
        path.write_text("\n".join(json.dumps(r) for r in _ROWS) + "\n", encoding="utf-8")
    else:
        sign = {".csv": ",", ".tsv": "\t"}[suffix]
        lines = [sign.join(_ROWS[0])] + [
            sign.join("" if v is None else f'"{v}"' for v in r.values()) for r in _ROWS
        ]
        path.write_text("\ufeff" + "\r\n".join(lines), encoding="utf-8")
    return path


@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".parquet", ".jsonl"])
def test_every_form_gives_the_same_rows(suffix: str, tmp_path: Path) -> None:
    path = _written(tmp_path, suffix)
    assert is_table(path)
    table = read_table(path)
    one, two = table.rows
    assert (one.name, one.path) == ("a/one.jpg", tmp_path / "a/one.jpg")
    assert (one.latitude_deg, one.longitude_deg, one.accuracy_m) == (48.99, 8.41, 25.0)
    assert one.time == datetime(2026, 3, 1, 12, tzinfo=UTC)
    assert (one.owner, one.licence, one.title) == ("Ann", "CC-BY-4.0", "Église, été")
    assert (two.latitude_deg, two.accuracy_m, two.time, two.owner) == (None, None, None, "")
    assert table.unknown_columns == ("views",)
    assert not table.bad


def test_what_is_wrong_costs_its_row_or_its_value_only(tmp_path: Path) -> None:
    path = tmp_path / "photos.csv"
    path.write_text(
        "Path;Latitude;lng;accuracy;time;licence\n"
        "one.jpg;48,99;8.41;5;2026:03:01 12:00:00;x\n"
        "two.jpg;95;8.41;-3;yesterday;x\n"
        ";48;8;5;;x\n"
        "three.jpg;0;0;;;x\n"
        "one.jpg;48;8;5;;x\n"
        "four.jpg;48;8\n"
        "five.jpg;48.5;8.5;nan;;x\n",
        encoding="utf-8",
    )
    table = read_table(path)
    rows = {r.name: r for r in table.rows}
    assert list(rows) == ["one.jpg", "two.jpg", "three.jpg", "five.jpg"]
    assert rows["one.jpg"].time == datetime(2026, 3, 1, 12)
    assert rows["one.jpg"].latitude_deg == 48.99  # columns are separated by semicolons
    assert [len(r.warnings) for r in rows.values()] == [0, 3, 1, 0]
    assert (rows["five.jpg"].latitude_deg, rows["five.jpg"].accuracy_m) == (48.5, None)
    assert [number for number, _ in table.bad] == [3, 5, 6]
    told = "\n".join(summary_of(table))
    assert (
        "values of 2 of 4 rows are left out, and what the photos say is used; row 2: 95.0, 8.41 is no" in told
    )
    assert "row 3 is left out: neither a path nor an id" in told
    assert "row 5 is left out: one.jpg is in row 1 already" in told
    assert "row 6 is left out: expected 6 values, found 3" in told


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('path,lat,lon\none.jpg,"48,99","8,41"\n', "row 1: lat '48,99' is no number"),
        (
            "path,easting,northing\none.jpg,456000,5420000\n",
            "no row has a position: expected columns lat and",
        ),
    ],
)
def test_a_table_without_usable_positions_says_so(text: str, told: str, tmp_path: Path) -> None:
    path = tmp_path / "photos.csv"
    path.write_text(text, encoding="utf-8")
    table = read_table(path)
    assert table.rows[0].latitude_deg is None
    assert told in "\n".join(summary_of(table))


def test_heights_and_how_good_they_are(tmp_path: Path) -> None:
    path = tmp_path / "ppk.csv"
    path.write_text(
        "path,lat,lon,altitude,accuracy,accuracy_height\none.jpg,48,8,123.45,0.02,0.03\ntwo.jpg,48,8,1e9,,-1\n"
    )
    one, two = read_table(path).rows
    assert (one.height_m, one.accuracy_m, one.accuracy_height_m) == (123.45, 0.02, 0.03)
    assert (two.height_m, two.accuracy_height_m, len(two.warnings)) == (None, None, 2)


def test_lines_of_json_that_are_none_are_told(tmp_path: Path) -> None:
    path = tmp_path / "photos.jsonl"
    path.write_text('{"id": "17"}\n\nnot json\n[1]\n{"id": 18, "lat": 1, "lon": 2}\n')
    (tmp_path / "17.jpg").write_bytes(b"x")
    table = read_table(path)
    assert [(r.number, r.name, r.path.name) for r in table.rows] == [(1, "17", "17.jpg"), (5, "18", "18")]
    assert [number for number, _ in table.bad] == [3, 4]


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.csv", b"lat,lon\n1,2\n", "a column `path` or `id`, found lat, lon"),
        ("a.csv", b"\xff\xfe\x00", "expected a table of photos"),
        ("a.parquet", b"PAR1 not really", "expected a table of photos"),
        ("a.jsonl", b"", "found no columns"),
    ],
)
def test_files_that_are_no_tables_are_refused(name: str, data: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(IngestError, match=message):
        read_table(tmp_path / name)


def test_a_folder_is_no_table(tmp_path: Path) -> None:
    (tmp_path / "holidays.csv").mkdir()
    assert not is_table(tmp_path / "holidays.csv")
    assert not is_table(tmp_path / "photo.jpg")


def test_what_the_table_says_of_heights_goes_before_exif(tmp_path: Path) -> None:
    Image.new("L", (64, 48)).save(tmp_path / "one.jpg")
    Image.new("L", (64, 48), 9).save(tmp_path / "two.jpg")
    table = tmp_path / "ppk.csv"
    table.write_text(
        "path,lat,lon,height,accuracy,accuracy_height\none.jpg,48,8,123.45,0.02,0.03\ntwo.jpg,48,8,130,2,\n"
    )
    one, two = (photo.gps for photo in scan_table(read_table(table), ScanOptions(trust_geotags=True)).photos)
    assert one is not None
    assert two is not None
    assert (one.height_m, one.sigma_horizontal_m, one.sigma_vertical_m) == (123.45, 0.02, 0.03)
    assert (two.height_m, two.sigma_horizontal_m, two.sigma_vertical_m) == (130.0, 2.0, 5.0)


def test_heights_of_exactly_zero_are_taken_as_unknown(tmp_path: Path) -> None:
    for number, name in enumerate(("one.jpg", "two.jpg")):
        Image.new("L", (320, 240), 99 * number).save(tmp_path / name)
    table = tmp_path / "photos.csv"
    for zero, heights in (("0.0", [None, 2.0]), ("-0.01", [-0.01, 2.0])):
        table.write_text(f"path,lat,lon,height,accuracy\none.jpg,48,8,{zero},4\ntwo.jpg,48.001,8,2,4\n")
        scanned = scan_table(read_table(table))
        assert [photo.gps and photo.gps.height_m for photo in scanned.photos] == heights
        told = "the heights of 1 photos are exactly zero, and are taken as unknown"
        assert (told in scanned.notes) == (heights[0] is None)


def test_a_table_of_another_place_than_exif_is_told_with_the_distance(tmp_path: Path) -> None:
    for number, name in enumerate(("one.jpg", "two.jpg", "three.jpg")):
        exif = Image.Exif()
        if number < 2:
            exif.get_ifd(ExifTags.IFD.GPSInfo).update(gps_directory((48.0, 8.0, 100.0)))
        Image.new("L", (320, 240), 9 * number).save(tmp_path / name, exif=exif)
    table = tmp_path / "photos.csv"
    head, rest = "path,lat,lon\none.jpg,48.1,8\n", "two.jpg,48.001,8\nthree.jpg,50,8\n"
    table.write_text(head + rest)
    (note,) = scan_table(read_table(table)).notes
    # 0.1 degrees along the meridian are 11.12 km there
    assert "1 of 2 photos lie more than 1 km from the positions in their EXIF, one.jpg by 11.1 km" in note
    table.write_text("path,lat,lon\n" + rest)
    assert scan_table(read_table(table)).notes == ()


def test_the_cameras_angles(tmp_path: Path) -> None:
    path = tmp_path / "photos.csv"
    path.write_text(
        "path,yaw,pitch,roll\na.jpg,30,-90,1\nb.jpg,30,,\nc.jpg,0,0,0\nd.jpg,900,-90,0\n", encoding="utf-8"
    )
    a, b, c, d = read_table(path).rows
    assert a.angles is not None
    assert b.angles is not None
    assert (a.angles.yaw_deg, a.angles.pitch_deg, a.angles.roll_deg) == (30.0, -90.0, 1.0)
    assert (b.angles.yaw_deg, b.angles.pitch_deg) == (30.0, None)
    assert c.angles is None
    assert d.angles is None
    assert len(d.warnings) == 1


def test_a_table_that_is_none_is_told_before_a_database_is_made(tmp_path: Path) -> None:
    table = tmp_path / "positions.csv"
    table.write_text("latitude,longitude\n46.8,-91.9\n")
    with pytest.raises(IngestError, match="expected a column `path` or `id`"):
        require_photos(table)
