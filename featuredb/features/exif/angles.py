"""How a photo says that its camera was turned: XMP of drones' makers, and EXIF's compass."""

from collections.abc import Mapping

from featuredb.features.exif.tiff_ifd import Ifd
from featuredb.geometry.camera_angles import CameraAngles

# Measured on the 18 photos of `brighton` (DJI) against its scan, decision 0013: of tilts 1.3 degrees of each
# photo and 1.5 of a strip, of yaw 1.8 and 2.2, widened for other compasses.
DEFAULT_SIGMA_YAW_DEG, DEFAULT_SIGMA_TILT_DEG = 4.0, 2.0
_COMPASS_SIGMA_DEG = 20.0  # of a phone, magnetic north among it; chosen
MOST_PITCH_DEG = 95.0  # straight up or down, and what gimbals overshoot
_LEAST_SIGMA_DEG = 0.05
# Names of yaw, pitch and roll of a camera, not of its aircraft, by an expression for their namespace.
DJI_GIMBAL = ("GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree")
XMP_GIMBALS = {
    "drone(?:-dji)?": DJI_GIMBAL,  # Autel's is without "-dji"
    "drone-parrot": ("CameraYawDegree", "CameraPitchDegree", "CameraRollDegree"),
}
XMP_BODY = ("Yaw", "Pitch", "Roll")  # of Pix4D's namespace, which senseFly, Parrot and others write


def camera_angles(
    gps: Ifd, xmp: Mapping[str, float], make: str, orientation: int, warnings: list[str]
) -> CameraAngles | None:
    """By gimbal, by IMU, by compass, whichever comes first; None where the photo does not say.

    All angles zero are how a camera writes that it knows none. Of a photo that is stored turned
    (`orientation`) only the compass counts: whether angles are those of the turned picture is not known.
    """
    xmp = xmp if orientation == 1 else {}
    for names in XMP_GIMBALS.values():
        yaw, pitch, roll = (xmp.get(name) for name in names)
        if pitch is None or (not yaw and not pitch and not roll):
            continue
        if abs(pitch) > MOST_PITCH_DEG:
            warnings.append(f"XMP: a camera's pitch of {pitch} degrees is absurd")
            continue
        return CameraAngles(
            yaw_deg=yaw,
            pitch_deg=pitch,
            roll_deg=roll or 0.0,
            sigma_yaw_deg=DEFAULT_SIGMA_YAW_DEG,
            sigma_tilt_deg=DEFAULT_SIGMA_TILT_DEG,
        )
    yaw, pitch, roll = (xmp.get(name) for name in XMP_BODY)
    if yaw is not None and pitch is not None and roll is not None and (yaw or pitch or roll):
        tilt = [xmp.get(f"IMU{name}Accuracy", 0.0) for name in ("Pitch", "Roll")]
        sense_fly = make.strip().lower() == "sensefly"  # counts roll the other way, as OpenDroneMap knows
        return CameraAngles.of_body(
            yaw,
            pitch,
            -roll if sense_fly else roll,
            sigma_yaw_deg=_stated(xmp.get("IMUYawAccuracy", 0.0), DEFAULT_SIGMA_YAW_DEG),
            sigma_tilt_deg=_stated(max(tilt), DEFAULT_SIGMA_TILT_DEG),
        )
    compass = gps.number(17)
    if compass is not None and 0.0 < compass <= 360.0:
        return CameraAngles(
            yaw_deg=compass, pitch_deg=None, sigma_yaw_deg=_COMPASS_SIGMA_DEG, sigma_tilt_deg=180.0
        )
    return None


def _stated(sigma_deg: float, default_deg: float) -> float:
    return max(sigma_deg, _LEAST_SIGMA_DEG) if 0.0 < sigma_deg <= 180.0 else default_deg
