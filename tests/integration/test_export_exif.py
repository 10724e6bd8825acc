"""Copies of photos that know their pose; the picture in them is the original's, bit for bit."""

import csv
import hashlib
import io
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from featuredb.cli.main import main
from featuredb.errors import ExportError, InvalidValueError
from featuredb.export.formats.exif import with_pose, write_exif
from featuredb.export.job import ExportJob
from featuredb.export.selection import Selection
from featuredb.export.shots import PosedPhoto, shots_of
from featuredb.features.exif.read import parse_exif, read_exif
from featuredb.features.exif.tiff_ifd import Ifd, TiffReader
from featuredb.features.exif.write import gps_directory, with_gps, with_properties
from featuredb.features.image_header import read_header
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from tests.support import planar_map as field
from tests.support.command_line import only_command

XMP = b"""<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about=""
 xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" xmlns:tiff="http://ns.adobe.com/tiff/1.0/"
 tiff:Make="DJI" drone-dji:GimbalYawDegree="-45.0" drone-dji:RtkFlag="50" drone-dji:RelativeAltitude="+39.80">
 <drone-dji:GimbalPitchDegree>-12.00</drone-dji:GimbalPitchDegree></rdf:Description></rdf:RDF></x:xmpmeta>
<?xpacket end="w"?>"""


def photo(seed: int, **saved: object) -> bytes:
    """A small JPEG of noise."""
    pixels = np.random.default_rng(seed).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "JPEG", quality=90, **saved)  # type: ignore[arg-type]
    return out.getvalue()


def exif_block(position: bool) -> bytes:
    exif = Image.Exif()
    exif[ExifTags.Base.Make.value], exif[ExifTags.Base.Model.value] = "DJI", "FC300S"
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.DateTimeOriginal.value] = "2026:05:01 12:00:00"
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.MakerNote.value] = b"maker " + bytes(range(200))
    if position:
        gps = exif.get_ifd(ExifTags.IFD.GPSInfo)
        gps[1], gps[2], gps[3], gps[4] = "N", (10.0, 20.0, 30.0), "E", (5.0, 6.0, 7.0)
        gps[7], gps[29], gps[11] = (11.0, 22.0, 33.0), "2026:05:01", 0.7
    return exif.tobytes()


def _gps(tiff: bytes) -> Ifd:
    reader = TiffReader(tiff)
    return reader.read(reader.read(reader.first_offset).number(0x8825))


def _above_ellipsoid(data: bytes) -> bool:
    exif = read_header(data).exif
    assert exif is not None
    return _gps(data[slice(*exif)]).values[5][0] in (2, 3)


def scans(data: bytes) -> bytes:
    """Everything but metadata: the segments that are no APP1, the compressed picture, and what follows."""
    at, kept = 2, [data[:2]]
    while data[at + 1] != 0xDA:
        stop = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if data[at + 1] != 0xE1:
            kept.append(data[at:stop])
        at = stop
    return b"".join(kept) + data[at:]


PHOTOS = {
    "plain.jpg": photo(0),
    "exif.jpg": photo(1, exif=exif_block(False)),
    "gps.jpg": photo(2, exif=exif_block(True), xmp=XMP, progressive=True),
    "motorola.jpg": photo(3, exif=exif_block(True), dpi=(72, 72)) + b"a preview behind the picture",
}


@pytest.fixture
def shot() -> PosedPhoto:
    return next(iter(shots_of(photo_map())))


@lru_cache(maxsize=1)
def photo_map() -> FeatureMap:
    """Four of the field's views, which are said to be the photos above."""
    feature_map = field.planar_map(map_id="field")
    names = [*PHOTOS, *(f"{k}.png" for k in range(4, 9))]
    images = tuple(
        replace(
            image,
            name=f"day/{name}" if name.endswith("jpg") else name,
            sha256=hashlib.sha256(PHOTOS[name]).hexdigest() if name in PHOTOS else image.sha256,
            owner="Ann" if k % 2 else "Bob <bob@example.org>",
            licence="CC-BY-4.0",
        )
        for k, (image, name) in enumerate(zip(feature_map.images, names, strict=True))
    )
    return replace(feature_map, images=images)


def job_of(tmp_path: Path) -> ExportJob:
    database = Database.create(tmp_path / "maps.db")
    database.commit_map(photo_map())
    return ExportJob(
        database=database, snapshot=database.snapshot(), selection=Selection(), out=tmp_path / "out"
    )


def folder_of_photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos" / "by another name"
    folder.mkdir(parents=True)
    for k, data in enumerate(PHOTOS.values()):
        (folder / f"{k}.jpeg").write_bytes(data)
    return tmp_path / "photos"


def test_copies_have_the_pose_and_the_very_picture(tmp_path: Path) -> None:
    folder = folder_of_photos(tmp_path)
    before = {path: path.read_bytes() for path in folder.rglob("*.jpeg")}
    done = write_exif(job_of(tmp_path), folder)
    assert done.images == 4
    feature_map = photo_map()
    for image, shot in zip(feature_map.images[:4], shots_of(feature_map), strict=False):
        data = (tmp_path / "out" / "field" / image.name).read_bytes()
        original = PHOTOS[image.name.removeprefix("day/")]
        assert scans(data) == scans(original)
        assert np.array_equal(
            np.asarray(Image.open(io.BytesIO(data))), np.asarray(Image.open(io.BytesIO(original)))
        )
        found = read_exif(data)
        assert found.warnings == ()
        assert found.latitude_deg is not None
        height = found.altitude_m if _above_ellipsoid(data) else shot.map_height_m
        enu = feature_map.frame.enu_from_geodetic((found.latitude_deg, found.longitude_deg, height))
        np.testing.assert_allclose(enu, image.cam_from_local.center, atol=1e-3)
        heading, pitch, roll = shot.geopose.heading_pitch_roll_deg
        assert found.angles is not None
        assert (found.angles.yaw_deg or 0.0) % 360 == pytest.approx(heading, abs=1e-4)
        assert found.angles.pitch_deg == pytest.approx(pitch, abs=1e-4)
        assert found.angles.roll_deg == pytest.approx(roll, abs=1e-4)
        assert found.sigma_vertical_m == pytest.approx(max(shot.sigma_enu_m[2], 0.005), abs=1e-3)
        per_axis = np.sqrt((shot.sigma_enu_m[:2] ** 2).mean())
        assert found.sigma_horizontal_m == pytest.approx(max(per_axis, 0.005), abs=1e-3)
        by_pillow = Image.open(io.BytesIO(data)).getexif().get_ifd(ExifTags.IFD.GPSInfo)
        assert float(by_pillow[17]) == pytest.approx(heading, abs=1e-4)
        assert by_pillow[16] == "T"
    assert {path: path.read_bytes() for path in folder.rglob("*.jpeg")} == before


def test_photos_that_are_not_there_are_named(tmp_path: Path) -> None:
    write_exif(job_of(tmp_path), folder_of_photos(tmp_path))
    with (tmp_path / "out" / "files.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 9
    assert [bool(row["file"]) for row in rows] == [True] * 4 + [False] * 5
    assert {row["reason"] for row in rows[4:]} == {"no file of these bytes in the folder"}
    with (tmp_path / "out" / "attribution.csv").open(encoding="utf-8", newline="") as file:
        credits = list(csv.DictReader(file))
    assert [c["owner"] for c in credits] == ["Bob <bob@example.org>", "Ann"] * 2
    with pytest.raises(ExportError, match="none of the 9 photos"):
        write_exif(replace(job_of(tmp_path), out=tmp_path / "none"), tmp_path / "out" / "field")
    assert not (tmp_path / "none").exists()


def test_what_else_the_photo_says_stays(shot: PosedPhoto) -> None:
    data = with_pose(PHOTOS["gps.jpg"], shot)
    header = read_header(data)
    assert header.exif is not None
    assert header.xmp is not None
    tiff = data[slice(*header.exif)]
    original = PHOTOS["gps.jpg"]
    before = read_header(original).exif
    assert before is not None
    # The block is the old one with something behind it: makers' notes keep their offsets.
    old = original[slice(*before)]
    changed = [k for k, (a, b) in enumerate(zip(old, tiff, strict=False)) if a != b]
    assert len(tiff) > len(old)
    assert max(changed) - min(changed) < 12
    gps = TiffReader(tiff).read(TiffReader(tiff).read(TiffReader(tiff).first_offset).number(0x8825))
    assert gps.numbers(7) == (11.0, 22.0, 33.0)
    assert gps.text(29) == "2026:05:01"
    assert 11 not in gps.values  # the receiver's dilution is not that of the map's pose
    xmp = data[slice(*header.xmp)]
    root = ET.fromstring(xmp[xmp.index(b"<x:xmpmeta") : xmp.index(b"<?xpacket end")])
    text = ET.tostring(root).decode()
    assert 'Make="DJI"' in text
    assert "+39.80" in text
    assert text.count("GimbalYawDegree") == text.count("GimbalPitchDegree") == 1
    assert "RtkFlag" not in text
    assert "Bob &lt;bob@example.org&gt;" in text


def test_twice_is_as_once_but_for_length(shot: PosedPhoto) -> None:
    """A photo that has been exported before gets one position and one set of angles, not two."""
    once = with_pose(PHOTOS["exif.jpg"], shot)
    twice = with_pose(once, shot)
    assert scans(twice) == scans(once)
    assert twice.count(b"GimbalYawDegree") == once.count(b"GimbalYawDegree") == 1
    assert read_exif(twice) == read_exif(once)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("has_gps", [True, False])
def test_both_byte_orders_and_every_quadrant(order: str, has_gps: bool) -> None:
    entries = [(0x010F, 2, 4, b"DJI\0")]
    body = struct.pack(order + "H", len(entries) + has_gps)
    for tag, kind, count, value in entries:
        body += struct.pack(order + "HHI", tag, kind, count) + value
    if has_gps:
        body += struct.pack(order + "HHII", 0x8825, 4, 1, 9999)  # a pointer to nowhere
    tiff = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8) + body + b"\0" * 4
    for lat, lon, h in ((10.123456789, 20.0, 5.5), (-33.9, -151.2, -3.25)):
        out = with_gps(tiff, gps_directory((lat, lon, h), "ellipsoid", heading_deg=359.99999, error_m=0.25))
        found = parse_exif(out, b"", 64, 48)
        assert found.make == "DJI"
        # A hundred-thousandth of an arc second is 0.3 mm.
        assert found.latitude_deg == pytest.approx(lat, abs=2e-9)
        assert found.longitude_deg == pytest.approx(lon, abs=2e-9)
        assert found.altitude_m == pytest.approx(h)
        gps = _gps(out)
        assert gps.values[5][0] == (3 if h < 0 else 2)
        assert gps.number(17) == 0.0
        assert found.warnings == ()


def test_metadata_that_fits_nowhere_is_a_reason(shot: PosedPhoto) -> None:
    long = XMP.replace(b'tiff:Make="DJI"', b'tiff:Make="' + b"x" * 64_600 + b'"')
    with pytest.raises(InvalidValueError, match="does not fit"):
        with_pose(photo(5, xmp=long), shot)


def test_the_padding_of_a_packet_costs_nothing() -> None:
    """Packets end in kilobytes of blanks; a search that began anew at each took seconds for a photo."""
    padded = XMP.replace(b"<?xpacket end", b" " * 60_000 + b"<?xpacket end")
    started = time.process_time()
    assert b"+12" in with_properties(padded, {"drone-dji:GimbalYawDegree": "+12"})
    assert time.process_time() - started < 0.5


def test_a_broken_packet_is_replaced() -> None:
    packet = with_properties(b"<not xmp", {"drone-dji:GimbalYawDegree": '1"<'})
    root = ET.fromstring(packet[packet.index(b"<x:xmpmeta") : packet.index(b"<?xpacket end")])
    assert root[0][0].attrib["{http://www.dji.com/drone-dji/1.0/}GimbalYawDegree"] == '1"<'


@pytest.mark.real_data
def test_a_drones_photo_keeps_its_makers_note_and_picture(shared_data: Path, shot: PosedPhoto) -> None:
    original = (shared_data / "brighton" / "images" / "DJI_0026.JPG").read_bytes()
    data = with_pose(original, shot)
    assert scans(data) == scans(original)
    before, after = read_exif(original), read_exif(data)
    assert (after.make, after.model, after.focal_px, after.capture_time) == (
        before.make, before.model, before.focal_px, before.capture_time,
    )  # fmt: skip
    altitude = re.compile(rb'drone-dji:RelativeAltitude="[^"]+"')
    assert altitude.findall(data) == altitude.findall(original) != []
    assert after.latitude_deg == pytest.approx(shot.geopose.latitude_deg, abs=2e-9)
    notes = [
        Image.open(io.BytesIO(d)).getexif().get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.MakerNote.value]
        for d in (original, data)
    ]
    assert notes[0] == notes[1]
    assert data.index(notes[0]) - (read_header(data).exif or (0,))[0] == (
        original.index(notes[0]) - (read_header(original).exif or (0,))[0]
    )


_KILLED = """
import os, signal, sys
from pathlib import Path
from featuredb.export.formats.exif import write_exif
from featuredb.export.job import ExportJob
from featuredb.export.selection import Selection
from featuredb.store import Database
database = Database.open(sys.argv[1])
write_exif(ExportJob(database=database, snapshot=database.snapshot(), selection=Selection(),
    out=Path(sys.argv[2]), told=lambda done, total: os.kill(os.getpid(), signal.SIGKILL)), Path(sys.argv[3]))
"""


def test_a_kill_in_the_middle_leaves_nothing(tmp_path: Path) -> None:
    job, folder = job_of(tmp_path), folder_of_photos(tmp_path)
    died = subprocess.run(
        [sys.executable, "-c", _KILLED, str(tmp_path / "maps.db"), str(job.out), str(folder)],
        capture_output=True, text=True, timeout=120, check=False, env=os.environ,
    )  # fmt: skip
    assert died.returncode == -signal.SIGKILL, died.stderr
    assert not job.out.exists()


def test_the_command_wants_the_photos(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with only_command(monkeypatch, "export", "featuredb.cli.export:register"):
        job_of(tmp_path)
        argv = ["export", str(tmp_path / "maps.db"), str(tmp_path / "out"), "--format", "exif"]
        assert main(argv) == 2
        assert "expected --photos FOLDER" in capsys.readouterr().err
        assert main([*argv, "--photos", str(tmp_path / "nowhere")]) == 2
        assert "expected the folder of the photos" in capsys.readouterr().err
        folder = folder_of_photos(tmp_path)
        assert main([*argv, "--photos", str(folder)]) == 0
        assert "exif, 1 maps, 4 images" in capsys.readouterr().out
        shutil.rmtree(folder)
