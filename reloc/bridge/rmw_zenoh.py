"""ROS 2 messages of a pose, published over Zenoh as rmw_zenoh publishes them: no ROS installation is needed.

Keys, liveliness tokens and attachments are those of rmw_zenoh_cpp since 0.2.4 (its page of design,
liveliness_utils.cpp and attachment_helpers.cpp in ros2/rmw_zenoh). Nodes receive the messages, and the tokens
show them in ROS 2's graph.
"""

import hashlib
import time
from contextlib import ExitStack
from typing import Any, Self

import zenoh
from zenoh.ext import Int64, z_serialize

from featuredb.errors import InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from reloc.bridge.robot_pose import RobotPose
from reloc.bridge.ros2 import TOPICS, messages
from reloc.client.connection import client_config

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


class RmwZenohNode:
    """A node that publishes the messages of poses, in ROS_DOMAIN_ID `domain`; a context manager.

    Raises:
        InvalidValueError: nobody is at the endpoint, or it is none; raised when the block begins.
    """

    def __init__(self, connect: str, *, domain: int = 0) -> None:
        self._connect = connect
        self._domain = domain
        self._sent = 0

    def __enter__(self) -> Self:
        try:
            session = zenoh.open(client_config(self._connect, _CONNECT_TIMEOUT_S))
        except zenoh.ZError as error:
            raise InvalidValueError(
                f"--connect: expected the endpoint of ROS 2's Zenoh router (ros2 run rmw_zenoh_cpp "
                f"rmw_zenohd), such as tcp/127.0.0.1:7447, found nobody at {self._connect}"
            ) from error
        with ExitStack() as opened:
            opened.enter_context(session)
            self._publishers = self._declared(session, opened)
            self._open = opened.pop_all()
        return self

    def __exit__(self, *failed: object) -> None:
        self._open.close()

    def write(self, pose: RobotPose, origin: LocalFrame) -> None:
        """Publish the three messages of a pose, in the frame `map` at this origin."""
        self._sent += 1
        for topic, data in messages(pose, origin).items():
            publisher, gid = self._publishers[topic]
            publisher.put(data, attachment=z_serialize((Int64(self._sent), Int64(time.time_ns()), gid)))

    def _declared(self, session: zenoh.Session, opened: ExitStack) -> dict[str, tuple[Any, bytes]]:
        """Tokens of the node and its publishers; of each topic its publisher and the id of that."""
        own = f"@ros2_lv/{self._domain}/{session.zid()}/{_NODE_ID}"
        place = f"%/%/{_NODE}"  # no enclave, no namespace
        tokens = [f"{own}/{_NODE_ID}/NN/{place}"]
        publishers = {}
        for number, (topic, (kind, _)) in enumerate(TOPICS.items(), start=1):
            package, name = kind.split("/msg/")
            of_type = f"{package}::msg::dds_::{name}_/RIHS01_{_TYPE_HASHES[topic]}"
            token = f"{own}/{number}/MP/{place}/{topic.replace('/', '%')}/{of_type}/{_QOS}"
            # A message that the network has no room for is dropped: the next one is newer.
            publisher = session.declare_publisher(
                f"{self._domain}{topic}/{of_type}",
                congestion_control=zenoh.CongestionControl.DROP,
                express=True,
            )
            gid = hashlib.blake2b(token.encode(), digest_size=_GID_BYTES).digest()
            publishers[topic] = (opened.enter_context(publisher), gid)
            tokens.append(token)
        for token in tokens:
            opened.enter_context(session.liveliness().declare_token(token))
        return publishers
