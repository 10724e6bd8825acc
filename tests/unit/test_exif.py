"""EXIF: values against what Pillow writes, and no harm from values that are wrong."""

import io
import math
import random
import struct
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from typing import Any

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from featuredb.features.exif.gps import DEFAULT_SIGMA_HORIZONTAL_M, DEFAULT_SIGMA_VERTICAL_M
from featuredb.features.exif.read import ExifInfo, focal_of_key, parse_exif, read_exif
from featuredb.geometry.camera_angles import CameraAngles, cam_from_enu
from featuredb.maps.feature_map import prior_from_exif

WIDTH, HEIGHT = 400, 300
FULL_FRAME_MM = math.hypot(36.0, 24.0)


def tiff(
    main: dict[int, Any] | None = None, exif: dict[int, Any] | None = None, gps: dict[int, Any] | None = None
) -> bytes:
    """A TIFF stream with these tags, written by Pillow."""
    container = Image.Exif()
    container.update(main or {})
    if exif:
        container.get_ifd(34665).update(exif)
    if gps:
        container.get_ifd(34853).update(gps)
    return container.tobytes().removeprefix(b"Exif\0\0")


def info(
    *directories: dict[int, Any] | None, xmp: bytes = b"", size: tuple[int, int] = (WIDTH, HEIGHT)
) -> ExifInfo:
    return parse_exif(tiff(*directories), xmp, *size)


def gps_tags(**changes: Any) -> dict[int, Any]:
    tags: dict[int, Any] = {
        1: "N",
        2: (46.0, 50.0, 33.3855),
        3: "W",
        4: (91.0, 59.0, 40.4156),
        5: b"\0",
        6: 198.309,
    }
    tags.update({int(key.removeprefix("t")): value for key, value in changes.items()})
    return {key: value for key, value in tags.items() if value is not None}


def test_all_kinds_of_values_from_a_file() -> None:
    exif = Image.Exif()
    exif.update({271: "Maker", 272: "Model X", 274: 6, 315: "A. Person", 33432: "CC BY 4.0"})
    exif.get_ifd(34665).update(
        {36867: "2024:05:06 07:08:09", 37521: "25", 36881: "+02:00", 41989: 24, 42033: "S1"}
    )
    exif.get_ifd(34853).update(gps_tags(t7=(5.0, 8.0, 9.5), t29="2024:05:06"))
    buffer = io.BytesIO()
    Image.new("L", (WIDTH, HEIGHT)).save(buffer, "JPEG", exif=exif)
    found = read_exif(buffer.getvalue())
    assert found.warnings == ()
    assert (found.make, found.model, found.serial, found.orientation) == ("Maker", "Model X", "S1", 6)
    assert (found.artist, found.copyright) == ("A. Person", "CC BY 4.0")
    assert found.capture_time == datetime(2024, 5, 6, 7, 8, 9, 250_000, tzinfo=timezone(timedelta(hours=2)))
    assert found.latitude_deg == pytest.approx(46 + 50 / 60 + 33.3855 / 3600, abs=1e-9)
    assert found.longitude_deg == pytest.approx(-(91 + 59 / 60 + 40.4156 / 3600), abs=1e-9)
    assert found.altitude_m == pytest.approx(198.309, abs=1e-6)
    assert found.focal_px == pytest.approx(24 * math.hypot(WIDTH, HEIGHT) / FULL_FRAME_MM, rel=1e-4)
    prior = prior_from_exif(found)
    assert prior is not None
    assert (prior.sigma_horizontal_m, prior.sigma_vertical_m) == (
        DEFAULT_SIGMA_HORIZONTAL_M,
        DEFAULT_SIGMA_VERTICAL_M,
    )


@pytest.mark.parametrize("kind", ["PNG", "WEBP", "TIFF"])
def test_metadata_of_other_formats(kind: str) -> None:
    exif = Image.Exif()
    exif[271] = "Maker"
    exif.get_ifd(34853).update(gps_tags())
    buffer = io.BytesIO()
    Image.new("RGB", (WIDTH, HEIGHT)).save(buffer, kind, exif=exif)
    found = read_exif(buffer.getvalue())
    assert found.make == "Maker"
    if kind != "TIFF":  # Pillow drops sub-directories there
        assert found.latitude_deg == pytest.approx(46.842607, abs=1e-6)


def test_no_metadata_at_all() -> None:
    assert parse_exif(b"", b"", WIDTH, HEIGHT) == ExifInfo(width=WIDTH, height=HEIGHT)
    assert prior_from_exif(ExifInfo()) is None


class TestFocalLength:
    def test_of_a_4_3_sensor_by_the_diagonal(self) -> None:
        # A 1/1.7 inch sensor, 7.44 x 5.58 mm, with 5.2 mm: the maker calls it 24 mm.
        found = info(None, {41989: 24}, size=(4000, 3000)).focal_px
        assert found == pytest.approx(5.2 / 7.44 * 4000, rel=0.02)

    def test_of_a_wide_crop_is_that_of_its_4_3_sensor(self) -> None:
        whole, crop = (info(None, {41989: 20}, size=size).focal_px for size in ((4000, 3000), (4000, 2250)))
        assert crop == pytest.approx(whole)
        # 3.61 mm on a sensor 6.17 mm wide.
        assert crop == pytest.approx(3.61 / 6.17 * 4000, rel=0.02)

    @pytest.mark.parametrize(("unit", "mm"), [(2, 25.4), (3, 10.0), (4, 1.0)])
    def test_by_the_sensors_resolution_in_any_unit(self, unit: int, mm: float) -> None:
        # 4272 pixels on 22.2 mm, 30 mm lens, stored at half size.
        tags = {37386: 30.0, 41486: 4272 / 22.2 * mm, 41488: unit, 40962: 4272, 40963: 2848}
        assert info(None, tags, size=(2136, 1424)).focal_px == pytest.approx(30 / 22.2 * 2136, rel=1e-3)

    def test_a_contradicting_resolution_is_not_believed(self) -> None:
        found = info(None, {37386: 5.0, 41486: 254.0 * 4, 41488: 2, 41989: 28}, size=(400, 300))
        assert found.focal_px == pytest.approx(28 * 500 / FULL_FRAME_MM, rel=1e-3)
        assert "disagree" in found.warnings[0]

    def test_pixels_turned_without_telling(self) -> None:
        turned = info(None, {41989: 28, 40962: 4000, 40963: 3000}, size=(1500, 2000)).focal_px
        assert turned == pytest.approx(28 * 2500 / FULL_FRAME_MM, rel=1e-3)

    def test_a_crop_at_full_resolution_keeps_the_focal_length(self) -> None:
        found = info(None, {41989: 28, 40962: 4000, 40963: 3000}, size=(4000, 2000)).focal_px
        assert found == pytest.approx(28 * 5000 / FULL_FRAME_MM, rel=1e-3)

    def test_a_crop_that_was_scaled_has_none(self) -> None:
        found = info(None, {41989: 28, 40962: 4000, 40963: 3000}, size=(1000, 1000))
        assert found.focal_px is None
        assert "cropped and scaled" in found.warnings[0]

    @pytest.mark.parametrize("value", [0, 65535])
    def test_absurd_equivalents(self, value: int) -> None:
        assert info(None, {41989: value}).focal_px is None

    def test_millimetres_alone_say_nothing(self) -> None:
        assert info(None, {37386: 4.2}).focal_px is None


class TestPosition:
    @pytest.mark.parametrize(
        ("changes", "word"),
        [
            ({"t2": (200.0, 0.0, 0.0)}, "latitude"),
            ({"t4": (181.0, 0.0, 0.0)}, "longitude"),
            ({"t2": (46.0, 61.0, 0.0)}, "latitude"),
            ({"t2": (46.0, 50.0, IFDRational(0, 0))}, "latitude"),
            ({"t2": None}, "latitude"),
            ({"t1": None}, "latitude"),
            ({"t3": "Q"}, "longitude"),
            ({"t2": (0.0, 0.0, 0.0), "t4": (0.0, 0.0, 0.0)}, "0, 0"),
            ({"t9": "V"}, "no fix"),
        ],
    )
    def test_a_wrong_one_is_none_with_a_reason(self, changes: dict[str, Any], word: str) -> None:
        found = info(None, None, gps_tags(**changes))
        assert found.latitude_deg is None
        assert found.longitude_deg is None
        assert found.altitude_m is None
        assert any(word in warning for warning in found.warnings)

    def test_degrees_with_fractions_need_no_minutes(self) -> None:
        found = info(None, None, gps_tags(t2=(46.5, 0.0, 0.0), t1="S"))
        assert found.latitude_deg == -46.5

    @pytest.mark.parametrize(
        ("reference", "altitude"),
        [(b"\0", 12.5), (b"\1", -12.5), (b"\2", 12.5), (b"\3", -12.5), (b"\7", 12.5), (None, 12.5)],
    )
    def test_altitude_and_its_sign(self, reference: bytes | None, altitude: float) -> None:
        found = info(None, None, gps_tags(t5=reference, t6=12.5))
        assert found.altitude_m == altitude
        assert bool(found.warnings) == (reference == b"\7")

    @pytest.mark.parametrize("altitude", [IFDRational(0, 0), 4_000_000.0])
    def test_absurd_altitudes_leave_the_position(self, altitude: Any) -> None:
        found = info(None, None, gps_tags(t6=altitude))
        assert found.altitude_m is None
        assert found.latitude_deg is not None
        assert len(found.warnings) == 1

    def test_sigma_by_positioning_error_is_a_68_percent_radius(self) -> None:
        found = info(None, None, gps_tags(t31=5.0))
        inside = 1 - math.exp(-0.5 * (5.0 / found.sigma_horizontal_m) ** 2)  # of a circular normal
        assert inside == pytest.approx(0.68, abs=1e-6)

    def test_sigma_by_dilution_of_precision(self) -> None:
        assert info(None, None, gps_tags(t11=2.0)).sigma_horizontal_m == pytest.approx(6.0)

    def test_absurd_errors_give_the_default(self) -> None:
        found = info(None, None, gps_tags(t31=1e8))
        assert found.sigma_horizontal_m == DEFAULT_SIGMA_HORIZONTAL_M
        assert found.warnings


class TestTime:
    def test_falls_back_to_the_next_readable_one(self) -> None:
        found = info({306: "2020:01:02 03:04:05"}, {36867: "0000:00:00 00:00:00", 36868: "gestern abend"})
        assert found.capture_time == datetime(2020, 1, 2, 3, 4, 5)
        assert any("gestern" in warning for warning in found.warnings)

    @pytest.mark.parametrize("offset", ["+99:00", "CEST", "+2"])
    def test_a_wrong_offset_leaves_local_time(self, offset: str) -> None:
        found = info(None, {36867: "2020:01:02 03:04:05", 36881: offset})
        assert found.capture_time == datetime(2020, 1, 2, 3, 4, 5)
        assert len(found.warnings) == 1

    def test_month_thirteen(self) -> None:
        assert info(None, {36867: "2020:13:02 03:04:05"}).capture_time is None


XMP = b"""<x:xmpmeta><rdf:Description drone-dji:RelativeAltitude="+39.80" drone-dji:GimbalYawDegree="-45.0"
 drone-dji:RtkFlag="50" drone-dji:RtkStdLon="0.012" drone-dji:RtkStdLat="0.015" drone-dji:RtkStdHgt="0.030">
 <drone-dji:GimbalPitchDegree>-89.90</drone-dji:GimbalPitchDegree></rdf:Description></x:xmpmeta>"""


def test_dji_values_as_attributes_and_elements() -> None:
    found = info(None, None, gps_tags(), xmp=XMP)
    assert found.angles is not None
    assert (found.angles.yaw_deg, found.angles.pitch_deg) == (-45.0, -89.9)
    assert (found.sigma_horizontal_m, found.sigma_vertical_m) == (0.015, 0.03)


def angles_of(xmp: bytes, make: str = "") -> CameraAngles | None:
    return info({271: make} if make else None, None, xmp=xmp).angles


def test_parrot_tells_the_camera_as_dji_does() -> None:
    found = angles_of(
        b'<x drone-parrot:CameraYawDegree="12.5" drone-parrot:CameraPitchDegree="-60" '
        b'drone-parrot:CameraRollDegree="1"/>'
    )
    assert found is not None
    assert (found.yaw_deg, found.pitch_deg, found.roll_deg) == (12.5, -60.0, 1.0)


@pytest.mark.parametrize(("make", "right"), [("Parrot", -1.0), ("senseFly", 1.0)])
def test_pix4d_counts_pitch_from_straight_down(make: str, right: float) -> None:
    """The nose 10 degrees up lets the camera look ahead, the right wing down lets it look to the left."""
    found = angles_of(
        b"<Camera:Yaw>90.0</Camera:Yaw><Camera:Pitch>10.0</Camera:Pitch><Camera:Roll>5.0</Camera:Roll>"
        b"<Camera:IMUYawAccuracy>10</Camera:IMUYawAccuracy><Camera:IMUPitchAccuracy>5</Camera:IMUPitchAccuracy>",
        make,
    )
    assert found is not None
    assert found.yaw_deg is not None
    assert found.pitch_deg is not None
    assert (found.sigma_yaw_deg, found.sigma_tilt_deg) == (10.0, 5.0)
    view = cam_from_enu(found.yaw_deg, found.pitch_deg, found.roll_deg)[2]
    pitch, roll = np.radians([10.0, right * 5.0])
    np.testing.assert_allclose(
        view, [np.cos(roll) * np.sin(pitch), -np.sin(roll), -np.cos(roll) * np.cos(pitch)]
    )


@pytest.mark.parametrize(
    "xmp",
    [
        b'<x drone-dji:GimbalYawDegree="+0.00" drone-dji:GimbalPitchDegree="0"/>',
        b'<x Camera:Yaw="0.0" Camera:Pitch="0.0" Camera:Roll="0.0"/>',
        b'<x drone-dji:FlightYawDegree="10" drone-dji:FlightPitchDegree="3" drone-dji:FlightRollDegree="1"/>',
    ],
)
def test_zeros_and_the_aircrafts_angles_are_none_of_the_camera(xmp: bytes) -> None:
    assert angles_of(xmp) is None


def test_a_compass_tells_only_yaw() -> None:
    found = info(None, None, gps_tags(t17=123.0)).angles
    assert found is not None
    assert (found.yaw_deg, found.pitch_deg) == (123.0, None)
    assert found.sigma_yaw_deg == 20.0


def test_autel_has_djis_names_in_a_namespace_of_its_own() -> None:
    found = info(None, None, gps_tags(), xmp=XMP.replace(b"drone-dji:", b"drone:"))
    assert (found.sigma_horizontal_m, found.sigma_vertical_m) == (0.015, 0.03)


def test_dji_single_point_solution_is_not_rtk() -> None:
    found = info(None, None, gps_tags(), xmp=XMP.replace(b'RtkFlag="50"', b'RtkFlag="16"'))
    assert found.sigma_horizontal_m == DEFAULT_SIGMA_HORIZONTAL_M


@pytest.mark.parametrize("longitude", ["GpsLongitude", "GpsLongtitude"])
def test_a_position_in_xmp_is_finer_than_one_of_cut_off_seconds(longitude: str) -> None:
    xmp = f'<x drone-dji:GpsLatitude="+46.8426071" drone-dji:{longitude}="-91.9945599"/>'.encode()
    found = info(None, None, gps_tags(t2=(46.0, 50.0, 33.4), t4=(91.0, 59.0, 40.4)), xmp=xmp)
    assert (found.latitude_deg, found.longitude_deg) == (46.8426071, -91.9945599)
    elsewhere = info(None, None, gps_tags(), xmp=xmp.replace(b"46.84", b"46.94"))
    assert elsewhere.latitude_deg == pytest.approx(46.8426071, abs=1e-6)


def test_accuracies_as_pix4d_names_them() -> None:
    xmp = b'<x Camera:GPSXYAccuracy="0.021"><Camera:GPSZAccuracy>0.04</Camera:GPSZAccuracy></x>'
    found = info(None, None, gps_tags(), xmp=xmp)
    assert (found.sigma_horizontal_m, found.sigma_vertical_m) == (0.021, 0.04)
    assert info(None, None, gps_tags(), xmp=xmp.replace(b"Camera", b"camera")).sigma_vertical_m == 0.04
    absurd = info(None, None, gps_tags(), xmp=b'<x Camera:GPSXYAccuracy="99999"/>')
    assert absurd.sigma_horizontal_m == DEFAULT_SIGMA_HORIZONTAL_M
    assert any("absurd" in warning for warning in absurd.warnings)


def test_camera_key_tells_zoom_positions_and_bodies_apart() -> None:
    photo = ExifInfo(make="Maker", model=" Model", width=400, height=300, focal_px=277.4)
    assert photo.camera_key == "maker|model|400x300|f277"
    assert replace(photo, make="maker", model="model", focal_px=277.49).camera_key == photo.camera_key
    others = [
        replace(photo, focal_px=280.0),
        replace(photo, width=300, height=400),
        replace(photo, focal_px=None),
        replace(photo, serial="S1"),
        replace(photo, resaved=True),
    ]
    assert len({photo.camera_key, *(other.camera_key for other in others)}) == 6
    assert replace(photo, make="", model=" ").camera_key == ""


def test_a_camera_key_tells_its_focal_length() -> None:
    photo = ExifInfo(make="Maker", model="5x5|f9", width=4000, height=3000, focal_px=2311.4)
    assert focal_of_key(photo.camera_key) == 2310.0
    assert focal_of_key(replace(photo, serial="77", resaved=True).camera_key) == 2310.0
    assert focal_of_key(replace(photo, model="M", focal_px=None).camera_key) is None
    assert focal_of_key("") is None


def test_photos_that_a_program_saved_anew_are_a_camera_of_their_own() -> None:
    """Cameras write EXIF first; a program that turns a picture writes a JFIF header and no turn."""
    exif = Image.Exif()
    exif[271], exif[272] = "Maker", "Model"
    buffer = io.BytesIO()
    Image.new("RGB", (400, 300)).save(buffer, "JPEG", exif=exif)
    anew = buffer.getvalue()
    length = int.from_bytes(anew[4:6], "big")
    assert anew[6:11] == b"JFIF\0"
    camera = anew[:2] + anew[4 + length :]
    assert read_exif(camera).camera_key == "maker|model|400x300|unknown"
    assert read_exif(anew).camera_key == "maker|model|400x300|unknown|jfif"
    assert replace(read_exif(anew), resaved=False) == read_exif(camera)


def _directory(entries: list[tuple[int, int, int, int]], next_ifd: int = 0) -> bytes:
    body = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    return b"II*\0\x08\0\0\0" + struct.pack("<H", len(entries)) + body + struct.pack("<I", next_ifd)


@pytest.mark.parametrize(
    "stream",
    [
        b"II",
        b"XX*\0\x08\0\0\0",
        b"II*\0\xff\xff\xff\xff",
        b"II*\0\x08\0\0\0\xff\xff",
        _directory([(34665, 4, 1, 8), (34853, 4, 1, 8)], next_ifd=8),  # directories that point at themselves
        _directory([(271, 2, 0xFFFFFFFF, 0)]),  # a text of 4 GB
        _directory([(271, 5, 0x20000000, 8)]),  # a size that wraps around in 32 bits
        _directory(
            [(271, 3, 1, 5), (274, 2, 4, 0), (272, 99, 1, 0)]
        ),  # numbers for text and back, no such type
        _directory([(34853, 2, 4, 0x41414141)]),  # a pointer that is text
    ],
)
def test_broken_streams_say_so_and_give_nothing(stream: bytes) -> None:
    found = parse_exif(stream, b"", WIDTH, HEIGHT)
    assert (found.make, found.model, found.focal_px, found.latitude_deg) == ("", "", None, None)


def test_random_changes_of_a_good_stream_never_raise() -> None:
    good = tiff(
        {271: "Maker", 274: 1}, {36867: "2024:05:06 07:08:09", 41989: 24, 37386: 4.2}, gps_tags(t31=3.0)
    )
    rng = random.Random(5)
    for _ in range(3000):
        data = bytearray(good)
        for _ in range(rng.randint(1, 6)):
            data[rng.randrange(len(data))] = rng.randrange(256)
        found = parse_exif(bytes(data[: rng.randint(1, len(data))]), b"", WIDTH, HEIGHT)
        if found.latitude_deg is not None:
            assert prior_from_exif(found) is not None  # validates itself
        assert found.focal_px is None or 0 < found.focal_px < 1e5
        assert found.sigma_horizontal_m > 0
        assert all(text.isprintable() for text in (found.make, found.model, found.artist))
