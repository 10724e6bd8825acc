"""ROS 2 messages of a pose, in CDR, and written into an MCAP file: no ROS installation is needed.

`/featuredb/pose` PoseWithCovarianceStamped in the frame `map` (east, north, up at the origin, REP 103 and
105), `/featuredb/fix` NavSatFix, and `/tf`, `map` to `base_link`. Bodies are forward, left, up.
"""

import hashlib
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import count
from pathlib import Path
from typing import Any, Self

import numpy as np
import zenoh
from zenoh.ext import Int64, z_serialize

from featuredb.errors import InvalidValueError
from featuredb.extras import require
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import quaternion_from_matrix
from reloc.bridge.robot_pose import RobotPose
from reloc.client.connection import client_config

_MAP, _BODY = "map", "base_link"
_COVARIANCE_KNOWN, _STATUS_FIX, _NO_SERVICE = 3, 0, 0
_LINE = "=" * 80 + "\nMSG: "
_TIME = f"{_LINE}builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_HEADER = f"{_LINE}std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n{_TIME}"
_QUATERNION = f"{_LINE}geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
_XYZ = "float64 x\nfloat64 y\nfloat64 z\n"
# Topic: type, definition.
TOPICS = {
    "/featuredb/pose": (
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n"
        f"{_LINE}geometry_msgs/PoseWithCovariance\ngeometry_msgs/Pose pose\nfloat64[36] covariance\n"
        f"{_LINE}geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
        f"{_LINE}geometry_msgs/Point\n{_XYZ}{_QUATERNION}{_HEADER}",
    ),
    "/featuredb/fix": (
        "sensor_msgs/msg/NavSatFix",
        "std_msgs/Header header\nsensor_msgs/NavSatStatus status\nfloat64 latitude\nfloat64 longitude\n"
        "float64 altitude\nfloat64[9] position_covariance\nuint8 position_covariance_type\n"
        f"{_LINE}sensor_msgs/NavSatStatus\nint8 status\nuint16 service\n{_HEADER}",
    ),
    "/tf": (
        "tf2_msgs/msg/TFMessage",
        "geometry_msgs/TransformStamped[] transforms\n"
        f"{_LINE}geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/Transform transform\n"
        f"{_LINE}geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\n"
        f"geometry_msgs/Quaternion rotation\n{_LINE}geometry_msgs/Vector3\n{_XYZ}{_QUATERNION}{_HEADER}",
    ),
}


Write = Callable[[RobotPose, LocalFrame], None]  # the three messages of a pose, in `map` at this origin


@contextmanager
def mcap_log(path: Path) -> Iterator[Write]:
    """Within the block, writes the messages of poses into a new file of ROS 2's profile.

    Raises:
        MissingExtraError: mcap is not installed.
        InvalidValueError: the file is there already, or cannot be written.
    """
    require("robots", "The ROS 2 bridge", "mcap.writer")
    from mcap.writer import Writer

    try:
        file = path.open("xb")  # a recording is never made twice
    except OSError as error:
        raise InvalidValueError(
            f"{path}: expected a new file in a folder that is there, found: {error.strerror}"
        ) from error
    with file:
        writer: Any = Writer(file)
        writer.start(profile="ros2", library="featuredb")
        channels: dict[str, int] = {}
        for topic, (name, definition) in TOPICS.items():
            schema = writer.register_schema(name, "ros2msg", definition.encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)

        def write(pose: RobotPose, origin: LocalFrame) -> None:
            stamp_ns = _nanoseconds(pose.time_s)
            for topic, data in messages(pose, origin).items():
                times = {"log_time": stamp_ns, "publish_time": stamp_ns}
                writer.add_message(channel_id=channels[topic], data=data, **times)

        try:
            yield write
        finally:
            writer.finish()


def messages(pose: RobotPose, origin: LocalFrame) -> dict[str, bytes]:
    """The CDR of each topic's message.

    NavSatFix wants heights above the ellipsoid; others are NaN there, which readers take for "not known".
    """
    place, turn, covariance = pose.in_frame(origin)
    quaternion = quaternion_from_matrix(turn)
    told = _Cdr().header(pose.time_s, _MAP).doubles(place).doubles(quaternion).doubles(covariance)
    height = pose.height_m if pose.height_datum == "ellipsoidal" else float("nan")
    fix = _Cdr().header(pose.time_s, _BODY).pack("b", _STATUS_FIX).pack("H", _NO_SERVICE)
    fix.doubles([pose.lat, pose.lon, height]).doubles(pose.covariance[:3, :3]).pack("B", _COVARIANCE_KNOWN)
    moved = _Cdr().pack("I", 1).header(pose.time_s, _MAP).string(_BODY).doubles(place).doubles(quaternion)
    return {"/featuredb/pose": told.data, "/featuredb/fix": fix.data, "/tf": moved.data}


def _nanoseconds(time_s: float) -> int:
    return round(time_s * 1e6) * 1000  # a double has no more of today's seconds


class _Cdr:
    """Plain CDR (OMG, XCDR 1), little-endian: each value at a multiple of its own size behind the header."""

    def __init__(self) -> None:
        self._body = bytearray()

    @property
    def data(self) -> bytes:
        return b"\x00\x01\x00\x00" + bytes(self._body)

    def pack(self, kind: str, value: float) -> Self:
        self._body += bytes(-len(self._body) % struct.calcsize(kind)) + struct.pack(f"<{kind}", value)
        return self

    def string(self, text: str) -> Self:
        encoded = text.encode() + b"\x00"
        self.pack("I", len(encoded))
        self._body += encoded
        return self

    def doubles(self, values: FloatArray | list[float]) -> Self:
        for value in np.ravel(values):
            self.pack("d", float(value))
        return self

    def header(self, time_s: float, frame_id: str) -> Self:
        nanoseconds = _nanoseconds(time_s)
        return (
            self.pack("i", nanoseconds // 1_000_000_000)
            .pack("I", nanoseconds % 1_000_000_000)
            .string(frame_id)
        )


_NODE, _NODE_ID = "featuredb", 0
# Of each topic's type, by its description (REP 2016), from Iron on; what has another hash is another type.
_TYPE_HASHES = {
    "/featuredb/pose": "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    "/featuredb/fix": "62223ab3fe210a15976021da7afddc9e200dc9ec75231c1b6a557fc598a65404",
    "/tf": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
}
# Reliable, volatile, the last ten; nothing stands for what is rmw_zenoh's default.
_QOS = "::,10:,:,:,,"
_GID_BYTES = 16
_CONNECT_TIMEOUT_S = 5.0


@contextmanager
def rmw_zenoh_node(connect: str, *, domain: int = 0) -> Iterator[Write]:
    """Within the block, a node that publishes the messages of poses, in ROS_DOMAIN_ID `domain`.

    Raises:
        InvalidValueError: nobody is at the endpoint, or it is none.
    """
    try:
        session = zenoh.open(client_config(connect, _CONNECT_TIMEOUT_S))
    except zenoh.ZError as error:
        raise InvalidValueError(
            f"--connect: expected the endpoint of ROS 2's Zenoh router (ros2 run rmw_zenoh_cpp "
            f"rmw_zenohd), such as tcp/127.0.0.1:7447, found nobody at {connect}"
        ) from error
    with ExitStack() as opened:
        opened.enter_context(session)
        publishers, numbers = _declared(session, domain, opened), count(1)

        def write(pose: RobotPose, origin: LocalFrame) -> None:
            number = Int64(next(numbers))
            for topic, data in messages(pose, origin).items():
                publisher, gid = publishers[topic]
                publisher.put(data, attachment=z_serialize((number, Int64(time.time_ns()), gid)))

        yield write


def _declared(session: zenoh.Session, domain: int, opened: ExitStack) -> dict[str, tuple[Any, bytes]]:
    """Tokens of the node and its publishers; of each topic its publisher and the id of that."""
    own = f"@ros2_lv/{domain}/{session.zid()}/{_NODE_ID}"
    place = f"%/%/{_NODE}"  # no enclave, no namespace
    tokens = [f"{own}/{_NODE_ID}/NN/{place}"]
    publishers = {}
    for number, (topic, (kind, _)) in enumerate(TOPICS.items(), start=1):
        package, name = kind.split("/msg/")
        of_type = f"{package}::msg::dds_::{name}_/RIHS01_{_TYPE_HASHES[topic]}"
        token = f"{own}/{number}/MP/{place}/{topic.replace('/', '%')}/{of_type}/{_QOS}"
        # A message that the network has no room for is dropped: the next one is newer.
        publisher = session.declare_publisher(
            f"{domain}{topic}/{of_type}",
            congestion_control=zenoh.CongestionControl.DROP,
            express=True,
        )
        gid = hashlib.blake2b(token.encode(), digest_size=_GID_BYTES).digest()
        publishers[topic] = (opened.enter_context(publisher), gid)
        tokens.append(token)
    for token in tokens:
        opened.enter_context(session.liveliness().declare_token(token))
    return publishers
