"""KML 2.2: a folder for each map, a PhotoOverlay for each photo that shows where it looks."""

import math
from xml.sax.saxutils import escape

from featuredb.export.job import Exported, ExportJob, whole_or_nothing
from featuredb.export.shots import PosedPhoto, altitude_of, shots_of

_NEAR_M = 10.0  # where the picture hangs ahead of the camera


def write_kml(job: ExportJob) -> Exported:
    """Write the photos of all selected maps to the file `job.out`.

    KML counts `absolute` altitudes from mean sea level (EGM96). Heights above the ellipsoid are converted
    where the geoid's grid is installed; the description of each folder says what the altitudes are.
    """
    with whole_or_nothing(job.out) as part:
        with part.open("w", encoding="utf-8", newline="\n") as out:
            out.write(
                '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document>\n'
            )
            for feature_map in job.maps():
                shots = list(shots_of(feature_map))
                datum = altitude_of(shots[0])[1] if shots else feature_map.height_datum
                told = f"map {feature_map.map_id}, {len(shots)} photos; altitudes: {datum}"
                out.write(
                    f"<Folder><name>{_text(feature_map.name or feature_map.map_id)}</name>"
                    f"<description>{_text(told)}</description>\n"
                )
                out.writelines(overlay(shot) for shot in shots)
                out.write("</Folder>\n")
            out.write("</Document></kml>\n")
        return job.exported(part)


def overlay(shot: PosedPhoto) -> str:
    """One photo as a PhotoOverlay.

    The camera looks down at tilt 0 and to the horizon at 90. Its roll turns about the axis that points from
    the picture to the viewer, right-handed: to the left, the other way round than `roll_deg` elsewhere.
    """
    place = shot.geopose
    heading, pitch, roll = place.heading_pitch_roll_deg
    altitude, _ = altitude_of(shot)
    left, right, bottom, top = field_of_view_deg(shot)
    where = f"{place.longitude_deg:.10f},{place.latitude_deg:.10f},{altitude:.4f}"
    when = ""
    if shot.image.capture_time is not None:  # without a zone where the photo names none
        when = f"<TimeStamp><when>{shot.image.capture_time.isoformat(timespec='seconds')}</when></TimeStamp>"
    data = "".join(
        f'<Data name="{name}"><value>{_text(value)}</value></Data>'
        for name, value in (
            ("map_id", shot.map_id),
            ("sha256", shot.image.sha256),
            ("owner", shot.image.owner),
            ("licence", shot.licence),
            ("heading_deg", f"{heading:.5f}"),
            ("pitch_deg", f"{pitch:.5f}"),
            ("roll_deg", f"{roll:.5f}"),
            ("sigma_enu_m", " ".join(f"{v:.4f}" for v in shot.sigma_enu_m)),
            ("map_height_m", f"{shot.map_height_m:.4f}"),
            ("map_height_datum", shot.map_height_datum),
        )
    )
    return (
        f"<PhotoOverlay><name>{_text(shot.image.name)}</name>"
        f"<description>{_text(_credit(shot))}</description>"
        f"<Camera><longitude>{place.longitude_deg:.10f}</longitude><latitude>{place.latitude_deg:.10f}</latitude>"
        f"<altitude>{altitude:.4f}</altitude><heading>{heading:.5f}</heading><tilt>{90.0 + pitch:.5f}</tilt>"
        f"<roll>{-roll + 0.0:.5f}</roll><altitudeMode>absolute</altitudeMode></Camera>{when}"
        f"<ExtendedData>{data}</ExtendedData><Icon><href>{_text(shot.image.name)}</href></Icon>"
        f"<ViewVolume><leftFov>{left:.5f}</leftFov><rightFov>{right:.5f}</rightFov>"
        f"<bottomFov>{bottom:.5f}</bottomFov><topFov>{top:.5f}</topFov><near>{_NEAR_M:g}</near></ViewVolume>"
        f"<Point><altitudeMode>absolute</altitudeMode><coordinates>{where}</coordinates></Point>"
        "</PhotoOverlay>\n"
    )


def field_of_view_deg(shot: PosedPhoto) -> tuple[float, float, float, float]:
    """Angles from the optical axis to the left, right, bottom and top edge, as KML signs them.

    By the focal length alone: KML's picture has no distortion.
    """
    camera = shot.camera
    pinhole = camera.to_pycolmap()
    fx, fy = pinhole.focal_length_x, pinhole.focal_length_y
    cx, cy = pinhole.principal_point_x, pinhole.principal_point_y
    edges = (-cx / fx, (camera.width - cx) / fx, -(camera.height - cy) / fy, cy / fy)
    left, right, bottom, top = (math.degrees(math.atan(edge)) for edge in edges)
    return left, right, bottom, top


def _credit(shot: PosedPhoto) -> str:
    owner, licence = shot.image.owner or "owner unknown", shot.licence or "licence unknown"
    horizontal = float((shot.sigma_enu_m[0] ** 2 + shot.sigma_enu_m[1] ** 2) ** 0.5)
    accuracy = f"{horizontal:.2f} m horizontally, {shot.sigma_enu_m[2]:.2f} m vertically"
    return f"{owner}; {licence}; position +- {accuracy}"


def _text(value: str) -> str:
    """Text of an element or attribute, without the characters that XML cannot hold."""
    return escape("".join(c for c in value if c >= " " or c in "\t\n"), {'"': "&quot;"})
