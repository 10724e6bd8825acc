"""Properties of poses and EXIF positions of the simulated world."""

from datetime import UTC, datetime
from fractions import Fraction

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import ExifTags

from featuredb.simworld.camera.photograph import Shot, exif_of, look_pose
from featuredb.simworld.flight import drone_device


@settings(deadline=None, max_examples=60)
@given(st.floats(0, 360), st.floats(-89, 89), st.floats(-179, 179), st.tuples(*[st.floats(-500, 500)] * 3))
def test_heading_pitch_roll_and_centre_are_recovered(
    heading: float, pitch: float, roll: float, center: tuple[float, float, float]
) -> None:
    pose = look_pose(center, heading, pitch, roll)
    np.testing.assert_allclose(pose.center, center, atol=1e-9)
    right, _, view = pose.rotation
    assert np.isclose(np.degrees(np.arcsin(view[2])), pitch, atol=1e-6)
    azimuth = np.degrees(np.arctan2(view[0], view[1]))
    assert np.isclose((azimuth - heading + 180) % 360, 180, atol=1e-6)
    # Rolled clockwise by r, the camera's right points down by sin(r), foreshortened by the pitch.
    assert np.isclose(right[2], -np.sin(np.radians(roll)) * np.cos(np.radians(pitch)), atol=1e-9)


@settings(deadline=None, max_examples=60)
@given(st.floats(-80, 84), st.floats(-180, 180), st.floats(-400, 8000))
def test_exif_positions_are_exact_anywhere(latitude: float, longitude: float, height: float) -> None:
    shot = Shot(
        name="a.jpg",
        device=drone_device(640),
        cam_from_local=look_pose((0, 0, 50), 0, -90),
        time=datetime(2025, 1, 1, tzinfo=UTC),
        seed=1,
    )
    gps = exif_of(shot, (latitude, longitude, height)).get_ifd(ExifTags.IFD.GPSInfo)
    for key, ref, value, negative in (
        (ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLatitudeRef, latitude, "S"),
        (ExifTags.GPS.GPSLongitude, ExifTags.GPS.GPSLongitudeRef, longitude, "W"),
    ):
        d, m, s = (Fraction(v.numerator, v.denominator) for v in gps[key])
        assert m < 60
        assert s < 60
        sign = -1 if gps[ref] == negative else 1
        assert abs(float(sign * (d + m / 60 + s / 3600)) - value) < 1.5e-9
    sign = -1 if gps[ExifTags.GPS.GPSAltitudeRef][0] == 1 else 1
    assert abs(sign * float(gps[ExifTags.GPS.GPSAltitude]) - height) < 0.00051
