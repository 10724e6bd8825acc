"""How much later than a server's reply the messages of a bridge are with their reader.

    python -m tools.bridge_latency DB PHOTO [--json FILE]

A server (`featuredb serve`) follows a film that shows the photo again and again. Of each bridge,
`featuredb live FILM --json | featuredb bridge ...` runs in processes of its own, and this process hears both:

- the server's reply, as any Zenoh subscriber beside `live` gets it from the wire;
- the bridge's message, decoded by the libraries of those who get it: pymavlink from a UDP port, rosbags from
  a Zenoh session that stands for ROS 2's router.

The bridge's latency is the difference of the two moments, pose by pose. A server is mostly another computer
than the robot's. Here it has a core of its own, so that its work on the next frame does not hold up the
bridge; `live`, the bridge and this process share the others. Figures say how busy the machine was (load).
"""

import json
import os
import select
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np
import zenoh
from pymavlink.dialects.v20 import common
from rosbags.typesys import Stores, get_typestore

from featuredb.features.decode import decode_rgb
from featuredb.geometry.arrays import FloatArray
from featuredb.video.writer import VideoWriter
from reloc.client.connection import client_config
from reloc.service.session import bind_free_port
from reloc.wire.keys import Keys
from reloc.wire.track import TrackPose
from tools.figures import study_parser, write_figures
from tools.serve_process import ServeProcess

_WIDTH, _FRAMES, _RATE_HZ = 1280, 1200, 10.0
_CONNECT_S = 10.0
_POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"


class Moments:
    """When replies and messages came (Unix time), by the microsecond when the server received the frame."""

    def __init__(self) -> None:
        self.replies: dict[int, float] = {}
        self.messages: dict[int, float] = {}

    def reply(self, sample: zenoh.Sample) -> None:
        """A pose of a live session, as the server sends it."""
        now = time.time()
        pose = TrackPose.model_validate_json(sample.payload.to_bytes())
        if pose.position is not None:
            self.replies[round(datetime.fromisoformat(pose.received_at).timestamp() * 1e6)] = now

    def message(self, time_us: int) -> None:
        """A message that is decoded."""
        self.messages.setdefault(time_us, time.time())

    def milliseconds(self) -> FloatArray:
        """(n,) from the reply to the message, of poses that have both."""
        both = self.replies.keys() & self.messages.keys()
        return np.array([1e3 * (self.messages[us] - self.replies[us]) for us in both])


def main() -> None:
    parser = study_parser(__doc__)
    parser.add_argument("db", type=Path)
    parser.add_argument("photo", type=Path, help="that the database localises")
    args = parser.parse_args()
    figures: dict[str, float] = {"load": os.getloadavg()[0]}
    with tempfile.TemporaryDirectory() as scratch:
        film = _film(Path(scratch) / "still.mp4", args.photo)
        server = _server_on_one_core(args.db)
        try:
            for name, bridge in (("mavlink", _mavlink), ("ros2", _ros2)):
                moments = Moments()
                with (
                    _listening(Keys(database="*").track("*", "*", "poses"), server.endpoint, moments.reply),
                    bridge(moments) as words,
                ):
                    _stream(film, server.endpoint, words)
                figures |= _figures(name, moments)
        finally:
            server.stop()
    write_figures(args.json, figures)


def _server_on_one_core(db: Path) -> ServeProcess:
    """A server whose processes share one core, which this process and what it starts later leave to it."""
    first, *others = sorted(os.sched_getaffinity(0))
    if not others:
        raise SystemExit("expected two cores or more, found one: a server needs one of its own")
    os.sched_setaffinity(0, {first})
    server = ServeProcess(db)
    os.sched_setaffinity(0, others)
    return server


def _film(path: Path, photo: Path) -> Path:
    rgb = decode_rgb(photo.read_bytes())
    height = round(_WIDTH * rgb.shape[0] / rgb.shape[1] / 2) * 2
    small = cv2.resize(rgb, (_WIDTH, height), interpolation=cv2.INTER_AREA)
    with VideoWriter(path, width=_WIDTH, height=height, fps=_RATE_HZ) as writer:
        for _ in range(_FRAMES):
            writer.write(small)
    return path


def _stream(film: Path, endpoint: str, words: Sequence[str]) -> None:
    """Run `live | bridge` to the film's end."""
    program = (sys.executable, "-m", "featuredb.cli")
    live = subprocess.Popen(
        [*program, "live", str(film), "--connect", endpoint, "--json"], stdout=subprocess.PIPE
    )
    bridge = subprocess.Popen([*program, "bridge", *words], stdin=live.stdout)
    live.stdout.close()
    codes = live.wait(), bridge.wait()
    if any(codes):
        raise SystemExit(f"live and bridge ended with {codes}")


@contextmanager
def _listening(key: str, endpoint: str, heard: Callable[[zenoh.Sample], None]) -> Iterator[None]:
    """A subscriber at a server, on Zenoh's own thread."""
    with zenoh.open(client_config(endpoint, _CONNECT_S)) as session:
        callback = zenoh.handlers.Callback(heard, indirect=False)
        with session.declare_subscriber(key, callback):
            yield


@contextmanager
def _mavlink(moments: Moments) -> Iterator[tuple[str, ...]]:
    """Hears `bridge mavlink`: what the bridge is told, while its packets are decoded."""
    decoder, over = common.MAVLink(None), threading.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.bind(("127.0.0.1", 0))

        def receive() -> None:
            while not over.is_set():
                if select.select([autopilot], [], [], 0.1)[0]:
                    for message in decoder.parse_buffer(autopilot.recv(2048)) or ():
                        moments.message(message.time_usec)

        thread = threading.Thread(target=receive)
        thread.start()
        try:
            yield "mavlink", "--to", f"udpout:127.0.0.1:{autopilot.getsockname()[1]}", "--mount", "down"
        finally:
            over.set()
            thread.join()


@contextmanager
def _ros2(moments: Moments) -> Iterator[tuple[str, ...]]:
    """Hears `bridge ros2 --connect`."""
    store = get_typestore(Stores.ROS2_JAZZY)
    endpoint = bind_free_port("tcp/127.0.0.1:0")
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")

    def heard(sample: zenoh.Sample) -> None:
        stamp = store.deserialize_cdr(sample.payload.to_bytes(), _POSE).header.stamp
        moments.message(stamp.sec * 1_000_000 + stamp.nanosec // 1000)

    with zenoh.open(config) as session:
        callback = zenoh.handlers.Callback(heard, indirect=False)
        with session.declare_subscriber("0/featuredb/pose/**", callback):
            yield "ros2", "--connect", endpoint, "--mount", "down"


def _figures(name: str, moments: Moments) -> dict[str, float]:
    late = moments.milliseconds()
    if not len(late):
        raise SystemExit(f"bridge {name}: no message of any of {len(moments.replies)} poses")
    return {
        f"{name}_poses": len(moments.replies),
        f"{name}_decoded": len(late),
        f"{name}_median_ms": float(np.median(late)),
        f"{name}_99_ms": float(np.quantile(late, 0.99)),
    }


if __name__ == "__main__":
    main()
