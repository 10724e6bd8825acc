"""Answers as other systems' messages, decoded by those systems' own libraries."""

import io
import json
import re
import socket
import time
from pathlib import Path

import numpy as np
import pyproj
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from pymavlink import mavutil
from pymavlink.dialects.v20 import common
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from featuredb.cli.main import main
from featuredb.errors import InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from reloc.bridge.mavlink import MavlinkSender, UdpLink
from reloc.bridge.nmea import sentences
from reloc.bridge.robot_pose import RobotPose, read_answers
from reloc.bridge.ros2 import mcap_log, messages
from tests.support.command_line import only_command

ORIGIN = LocalFrame(latitude_deg=-33.86, longitude_deg=151.2, height_m=20.0)
PLACE = np.array([12.0, 345.0, 6.0])  # east, north, up of the origin
HEADING_DEG, PITCH_DEG, ROLL_DEG = 30.0, 10.0, -5.0  # of the body: clockwise from north, nose up, right down
TIME_S = 1_764_163_800.25
ROOT = np.random.default_rng(0).normal(size=(6, 6)) * np.repeat([0.002, 0.1], 3)[:, None]
GIVEN = ROOT @ ROOT.T  # rotation before displacement, east, north, up


def body_from_angles() -> Rotation:
    """East, north, up from forward, left, up, by the angles of aviation."""
    ned_from_frd = Rotation.from_euler("ZYX", [HEADING_DEG, PITCH_DEG, ROLL_DEG], degrees=True).as_matrix()
    swap = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])
    return Rotation.from_matrix(swap @ ned_from_frd @ np.diag([1.0, -1.0, -1.0]))


def answer(turn: Rotation, datum: str = "ellipsoidal") -> dict[str, object]:
    lat, lon, h = (float(v) for v in ORIGIN.geodetic_from_enu(PLACE))
    x, y, z, w = turn.as_quat()
    return {
        "position": {"lat": lat, "lon": lon, "h": h},
        "quaternion": {"x": x, "y": y, "z": z, "w": w},
        "covariance": GIVEN.tolist(),
        "height_datum": datum,
        "received_at": "2025-11-26T13:30:00.250000+00:00",
    }


def pose(datum: str = "ellipsoidal", turn: Rotation | None = None, mount: str = "forward") -> RobotPose:
    line = json.dumps(answer(turn or body_from_angles(), datum))
    ((found, _),) = read_answers([line, "\n"], mount, lambda: 0.0)  # type: ignore[arg-type]
    return found


def decoded(packet: bytes) -> object:
    (message,) = common.MAVLink(None).parse_buffer(packet)
    return message


def test_odometry_is_north_east_down_with_its_covariance() -> None:
    (packet,) = MavlinkSender(("odometry",)).pack(pose(), ORIGIN)
    found = decoded(packet)
    assert found.get_type() == "ODOMETRY"
    assert (found.frame_id, found.child_frame_id) == (common.MAV_FRAME_LOCAL_NED, common.MAV_FRAME_BODY_FRD)
    np.testing.assert_allclose([found.x, found.y, found.z], [345.0, 12.0, -6.0], atol=1e-3)
    w, x, y, z = found.q
    yaw, pitch, roll = Rotation.from_quat([x, y, z, w]).as_euler("ZYX", degrees=True)
    np.testing.assert_allclose([yaw, pitch, roll], [HEADING_DEG, PITCH_DEG, ROLL_DEG], atol=5e-3)
    assert found.time_usec == round(TIME_S * 1e6)
    unknown = [found.vx, found.vy, found.vz, found.rollspeed, found.pitchspeed, found.yawspeed]
    assert np.isnan([*unknown, *found.velocity_covariance]).all()
    assert (found.estimator_type, found.quality) == (common.MAV_ESTIMATOR_TYPE_VISION, 0)  # 0: not told
    np.testing.assert_allclose(found.pose_covariance, upper(), rtol=2e-3, atol=1e-6)


def upper() -> FloatArray:
    """Covariance of north, east, down, roll, pitch, yaw, row by row from the diagonal on.

    By differences of SciPy's angles: MAVLink's roll turns first, about the nose.
    """
    swap, step = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]]), 1e-6

    def angles(error: FloatArray) -> FloatArray:
        turned = (Rotation.from_rotvec(error) * body_from_angles()).as_matrix()
        return Rotation.from_matrix(swap @ turned @ np.diag([1.0, -1.0, -1.0])).as_euler("ZYX")[::-1]

    by_given = np.zeros((6, 6))
    by_given[:3, 3:] = swap
    for axis, error in enumerate(step * np.eye(3)):
        by_given[3:, axis] = (angles(error) - angles(-error)) / (2.0 * step)
    return (by_given @ GIVEN @ by_given.T)[np.triu_indices(6)]


def test_the_vision_estimate_has_the_covariance_of_its_angles() -> None:
    (packet,) = MavlinkSender(("vision",)).pack(pose(), ORIGIN)
    found = decoded(packet)
    assert found.get_type() == "VISION_POSITION_ESTIMATE"
    angles = np.degrees([found.roll, found.pitch, found.yaw])
    np.testing.assert_allclose(angles, [ROLL_DEG, PITCH_DEG, HEADING_DEG], atol=5e-3)
    np.testing.assert_allclose([found.x, found.y, found.z], [345.0, 12.0, -6.0], atol=1e-3)
    assert found.usec == round(TIME_S * 1e6)
    np.testing.assert_allclose(found.covariance, upper(), rtol=2e-3, atol=1e-6)


def test_places_are_those_that_proj_gives() -> None:
    """Local coordinates of ODOMETRY and of the frame `map` by PROJ's topocentric conversion."""
    position = answer(body_from_angles())["position"]
    pipeline = (
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +step "
        f"+proj=topocentric +lat_0={ORIGIN.latitude_deg} +lon_0={ORIGIN.longitude_deg} +h_0={ORIGIN.height_m}"
    )
    place = [position[name] for name in ("lon", "lat", "h")]  # type: ignore[index]
    east, north, up = pyproj.Transformer.from_pipeline(pipeline).transform(*place)
    found = decoded(MavlinkSender(("odometry",)).pack(pose(), ORIGIN)[0])
    np.testing.assert_allclose([found.x, found.y, found.z], [north, east, -up], atol=1e-4)
    made = messages(pose(), ORIGIN)["/featuredb/pose"]
    store = get_typestore(Stores.ROS2_HUMBLE)
    at = store.deserialize_cdr(made, "geometry_msgs/msg/PoseWithCovarianceStamped").pose.pose.position
    np.testing.assert_allclose([at.x, at.y, at.z], [east, north, up], atol=1e-6)


@pytest.mark.parametrize(
    ("datum", "geoid_m", "altitude"), [("egm96", None, 26.0), ("ellipsoidal", 22.5, 3.5)]
)
def test_gps_input_has_altitudes_of_sea_level(datum: str, geoid_m: float | None, altitude: float) -> None:
    sender = MavlinkSender(("gps",), geoid_m=geoid_m)
    found = decoded(sender.pack(pose(datum), ORIGIN)[0])
    assert found.get_type() == "GPS_INPUT"
    lat, lon, _ = ORIGIN.geodetic_from_enu(PLACE)
    np.testing.assert_allclose([found.lat, found.lon], [lat * 1e7, lon * 1e7], atol=0.6)
    assert abs(found.alt - altitude) < 0.02  # the Earth is round
    assert not found.ignore_flags & common.GPS_INPUT_IGNORE_FLAG_ALT
    assert found.horiz_accuracy == pytest.approx(np.sqrt(GIVEN[3, 3] + GIVEN[4, 4]), rel=1e-5)
    assert found.vert_accuracy == pytest.approx(np.sqrt(GIVEN[5, 5]), rel=1e-5)
    assert found.yaw == pytest.approx(100 * HEADING_DEG, abs=1)
    assert (found.time_week, found.time_week_ms) == (2394, 307_818_250)  # Wednesday, 13:30:18.25 GPS


def test_gps_input_has_no_altitude_where_the_datum_does_not_tell_it() -> None:
    for datum, geoid_m in (("ellipsoidal", None), ("unknown", 22.5)):
        found = decoded(MavlinkSender(("gps",), geoid_m=geoid_m).pack(pose(datum), ORIGIN)[0])
        assert found.ignore_flags & common.GPS_INPUT_IGNORE_FLAG_ALT
        assert ",,M" not in sentences(pose(datum), None)[0]


def test_packets_arrive_at_an_autopilot_s_port() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    autopilot = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", dialect="common")
    sender = MavlinkSender(("odometry", "gps"))
    with UdpLink(f"udpout:127.0.0.1:{port}") as link:
        for placed in read_answers([json.dumps(answer(body_from_angles()))] * 2, "forward", time.time):
            for packet in sender.pack(*placed):
                link.send(packet)
    found = [autopilot.recv_match(blocking=True, timeout=5.0) for _ in range(4)]
    autopilot.close()
    assert [m.get_type() for m in found] == ["ODOMETRY", "GPS_INPUT"] * 2
    assert [m.get_seq() for m in found] == [0, 1, 2, 3]
    assert (found[0].x, found[0].y, found[0].z) == (0.0, 0.0, 0.0)  # the first pose is the origin
    with pytest.raises(InvalidValueError, match="udpout"):
        UdpLink("serial:/dev/ttyS0")


def test_a_host_is_known_before_any_answer_and_a_lost_packet_ends_nothing(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def unknown(*args: object, **more: object) -> None:
        raise socket.gaierror(-2, "Name or service not known")

    with monkeypatch.context() as without_names:
        without_names.setattr(socket, "getaddrinfo", unknown)
        with pytest.raises(InvalidValueError, match=r"--to: .*no\.such\.host"):
            UdpLink("udpout:no.such.host:1")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.bind(("127.0.0.1", 0))
        autopilot.settimeout(5.0)
        with UdpLink(f"udpout:127.0.0.1:{autopilot.getsockname()[1]}") as link:
            link.send(bytes(70_000))  # more than a datagram holds: the network refuses it
            link.send(bytes(70_000))
            link.send(b"next")
            assert autopilot.recv(16) == b"next"
        assert link.lost == 2
    assert len(caplog.records) == 1
    assert "a packet was not sent" in caplog.text


def test_a_recording_is_not_written_over(tmp_path: Path) -> None:
    there = tmp_path / "run.mcap"
    there.write_bytes(b"an earlier flight")
    for path in (there, tmp_path / "no/run.mcap"):
        with pytest.raises(InvalidValueError, match="expected a new file"), mcap_log(path):
            pass
    assert there.read_bytes() == b"an earlier flight"


def test_help_says_what_ardupilot_takes_and_how_to_write_a_southern_origin(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    with only_command(monkeypatch, "bridge", "reloc.cli.bridge:register"):
        assert main(["bridge", "mavlink", "--help"]) == 0
        said = " ".join(capsys.readouterr().out.split())
        assert "For ArduPilot: --message vision" in said
        (origin,) = re.findall(r"--origin=-\S+,\S+,\S+\b", said)
        monkeypatch.setattr("sys.stdin", io.StringIO(json.dumps(answer(body_from_angles()))))
        assert main(["bridge", "ros2", "--out", "/dev/null/run.mcap", origin]) == 2
    assert "/dev/null/run.mcap: expected a new file" in capsys.readouterr().err


def test_a_camera_that_looks_down_is_on_a_level_vehicle() -> None:
    """The picture's top towards the nose, which heads 30 degrees east of north."""
    heading = np.radians(HEADING_DEG)
    ahead, up = np.array([np.sin(heading), np.cos(heading), 0.0]), np.array([0.0, 0.0, 1.0])
    looks_down = Rotation.from_matrix(np.column_stack([-up, np.cross(up, ahead), ahead]))
    down = pose(turn=looks_down, mount="down")
    found = decoded(
        MavlinkSender(("vision",)).pack(
            down, LocalFrame(latitude_deg=down.lat, longitude_deg=down.lon, height_m=down.height_m)
        )[0]
    )
    np.testing.assert_allclose([found.roll, found.pitch, found.yaw], [0.0, 0.0, heading], atol=1e-5)


def test_ros_messages_are_read_by_two_libraries(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    made = messages(pose(), ORIGIN)
    told = store.deserialize_cdr(made["/featuredb/pose"], "geometry_msgs/msg/PoseWithCovarianceStamped")
    assert told.header.frame_id == "map"
    assert (told.header.stamp.sec, told.header.stamp.nanosec) == (int(TIME_S), 250_000_000)
    at, q = told.pose.pose.position, told.pose.pose.orientation
    np.testing.assert_allclose([at.x, at.y, at.z], PLACE, atol=1e-6)
    assert (Rotation.from_quat([q.x, q.y, q.z, q.w]) * body_from_angles().inv()).magnitude() < 1e-4
    swap = [3, 4, 5, 0, 1, 2]
    np.testing.assert_allclose(
        told.pose.covariance.reshape(6, 6), GIVEN[np.ix_(swap, swap)], atol=1e-5
    )  # over 345 m axes turn by 5e-5
    fix = store.deserialize_cdr(made["/featuredb/fix"], "sensor_msgs/msg/NavSatFix")
    np.testing.assert_allclose([fix.latitude, fix.longitude, fix.altitude], ORIGIN.geodetic_from_enu(PLACE))
    np.testing.assert_allclose(fix.position_covariance.reshape(3, 3), GIVEN[3:, 3:])
    assert (fix.position_covariance_type, fix.status.status, fix.status.service) == (3, 0, 0)
    (moved,) = store.deserialize_cdr(made["/tf"], "tf2_msgs/msg/TFMessage").transforms
    assert (moved.header.frame_id, moved.child_frame_id) == ("map", "base_link")
    q = moved.transform.rotation
    assert (Rotation.from_quat([q.x, q.y, q.z, q.w]) * body_from_angles().inv()).magnitude() < 1e-4
    for header in (fix.header, moved.header):
        assert (header.stamp.sec, header.stamp.nanosec) == (int(TIME_S), 250_000_000)
    assert fix.header.frame_id == "base_link"
    np.testing.assert_allclose(
        [getattr(moved.transform.translation, axis) for axis in "xyz"], PLACE, atol=1e-6
    )

    path = tmp_path / "run.mcap"
    with mcap_log(path) as write:
        write(pose(), ORIGIN)
        write(pose("unknown"), ORIGIN)
    read = {}
    with path.open("rb") as file:
        for _, channel, _, told in make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            read.setdefault(channel.topic, []).append(told)
    assert {topic: len(found) for topic, found in read.items()} == dict.fromkeys(made, 2)
    assert read["/featuredb/pose"][0].pose.pose.position.y == pytest.approx(345.0, abs=1e-6)
    assert read["/tf"][1].transforms[0].child_frame_id == "base_link"
    assert np.isnan(read["/featuredb/fix"][1].altitude)


def test_nmea_says_place_and_standard_deviations() -> None:
    gga, gst = sentences(pose("egm96"))
    for line in (gga, gst):
        body, _, checksum = line.strip()[1:].partition("*")
        assert int(checksum, 16) == np.bitwise_xor.reduce(list(body.encode()))
        assert line.endswith("\r\n")
    cells = gga.split(",")
    assert cells[0] == "$GPGGA"
    assert cells[1] == "133000.25"
    lat, lon, _ = ORIGIN.geodetic_from_enu(PLACE)
    south, east = (
        float(cells[2][:2]) + float(cells[2][2:]) / 60,
        float(cells[4][:3]) + float(cells[4][3:]) / 60,
    )
    np.testing.assert_allclose([-south, east], [lat, lon], atol=1e-7)
    assert (cells[3], cells[5]) == ("S", "E")
    assert float(cells[9]) == pytest.approx(26.0, abs=0.02)
    numbers = [float(cell) for cell in gst.partition("*")[0].split(",")[3:]]
    east_m, north_m, up_m = np.sqrt(np.diag(GIVEN)[3:])
    np.testing.assert_allclose(numbers[3:], [north_m, east_m, up_m], atol=1e-3)
    turn = np.radians(numbers[2])
    along = np.array([np.sin(turn), np.cos(turn)])  # the major axis, from north
    assert along @ GIVEN[3:5, 3:5] @ along == pytest.approx(numbers[0] ** 2, rel=0.02)


def test_answers_without_a_pose_are_passed_over_and_others_refused() -> None:
    lost = json.dumps({"state": "lost", "position": None})
    assert list(read_answers(io.StringIO(lost + "\n"), "forward", lambda: 0.0)) == []
    for line in ("no JSON", '{"status": "localised"}'):
        with pytest.raises(InvalidValueError, match="bridge: expected"):
            list(read_answers([line], "forward", lambda: 0.0))
