"""Subcommand `bridge`; what it needs is imported when it runs."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from featuredb.cli.common import numbers
from featuredb.errors import InvalidValueError

if TYPE_CHECKING:
    from collections.abc import Callable

    from featuredb.geo.local_frame import LocalFrame
    from reloc.bridge.robot_pose import RobotPose

_MOST_DOMAIN = 232  # of ROS 2
_NO_POSE = 1  # exit code: everything worked, and no answer had a pose


def register(subparsers: Any) -> None:
    """Add `bridge` to the parser of `featuredb`."""
    bridge = subparsers.add_parser(
        "bridge",
        help="hand answers on to robots",
        description="Read answers from standard input, a JSON object a line, as `featuredb live --json` and "
        "`featuredb query --json` print them, and hand them on.",
    )
    kinds = bridge.add_subparsers(dest="kind", required=True, metavar="KIND")
    mavlink = kinds.add_parser("mavlink", help="MAVLink 2 to an autopilot", description="Send MAVLink 2.")
    mavlink.add_argument("--to", required=True, metavar="udpout:HOST:PORT", help="where packets go")
    mavlink.add_argument(
        "--message",
        action="append",
        choices=("odometry", "vision", "gps"),
        help="ODOMETRY, VISION_POSITION_ESTIMATE or GPS_INPUT; may be repeated; default odometry, which "
        "PX4 takes. For ArduPilot: --message vision",
    )
    ros2 = kinds.add_parser(
        "ros2",
        help="ROS 2 messages in an MCAP file or over Zenoh",
        description="Write an MCAP file, publish to ROS 2 nodes whose middleware is rmw_zenoh, or both.",
    )
    ros2.add_argument("--out", type=Path, metavar="FILE.mcap", help="file to write")
    ros2.add_argument(
        "--connect", metavar="ENDPOINT", help="ROS 2's Zenoh router, where to publish: tcp/127.0.0.1:7447"
    )
    ros2.add_argument("--domain", type=int, default=0, metavar="ID", help="ROS_DOMAIN_ID; default 0")
    nmea = kinds.add_parser("nmea", help="NMEA 0183 to standard output", description="Print GGA and GST.")
    for kind in (mavlink, ros2):
        kind.add_argument(
            "--origin",
            type=lambda text: numbers(text, "LAT,LON,H in degrees and metres such as 47.37,8.54,408", 3),
            metavar="LAT,LON,H",
            help="of the local frame, WGS84 degrees and metres; with an equals sign where the latitude is "
            "negative: --origin=-33.86,151.21,20; default: the first pose",
        )
    for kind in (mavlink, nmea):
        kind.add_argument(
            "--geoid", type=float, metavar="M", help="height of the geoid over the ellipsoid there"
        )
    for kind, run in ((mavlink, _mavlink), (ros2, _ros2), (nmea, _nmea)):
        kind.add_argument(
            "--mount",
            choices=("forward", "down"),
            default="forward",
            help="how the camera looks from the vehicle; down: the picture's top is towards the nose; "
            "default forward",
        )
        kind.set_defaults(run=run)


def _passed_on(args: argparse.Namespace, *sends: "Callable[[RobotPose, LocalFrame], None]") -> int:
    """How many poses of standard input were sent, each with its local frame."""
    import time

    from featuredb.geo.local_frame import LocalFrame
    from reloc.bridge.robot_pose import read_answers

    origin = None
    if getattr(args, "origin", None) is not None:
        origin = LocalFrame(
            **dict(zip(("latitude_deg", "longitude_deg", "height_m"), args.origin, strict=True))
        )
    count = 0
    for placed in read_answers(sys.stdin, args.mount, time.time, origin):
        for send in sends:
            send(*placed)
        count += 1
    return count


def _mavlink(args: argparse.Namespace) -> int:
    from reloc.bridge.mavlink import MavlinkSender, UdpLink

    sender = MavlinkSender(args.message or ("odometry",), geoid_m=args.geoid)

    def send(pose: "RobotPose", origin: "LocalFrame") -> None:
        for packet in sender.pack(pose, origin):
            link.send(packet)

    with UdpLink(args.to) as link:
        count = _passed_on(args, send)
    lost = f"; {link.lost} packets were not sent" if link.lost else ""
    return _said(f"{count} poses sent to {args.to}{lost}", count)


def _ros2(args: argparse.Namespace) -> int:
    from contextlib import ExitStack

    from reloc.bridge.ros2 import Write, mcap_log, rmw_zenoh_node

    if args.out is None and args.connect is None:
        raise InvalidValueError("bridge ros2: expected --out FILE.mcap, --connect ENDPOINT or both")
    if not 0 <= args.domain <= _MOST_DOMAIN:
        raise InvalidValueError(f"--domain: expected 0 to {_MOST_DOMAIN}, found {args.domain}")
    with ExitStack() as opened:
        sinks: list[Write] = []
        if args.connect is not None:
            sinks.append(opened.enter_context(rmw_zenoh_node(args.connect, domain=args.domain)))
        if args.out is not None:  # begun once the router is there: nothing is overwritten for nothing
            sinks.append(opened.enter_context(mcap_log(args.out)))
        count = _passed_on(args, *sinks)
    where = " and ".join(str(what) for what in (args.out, args.connect) if what is not None)
    return _said(f"{count} poses written to {where}", count)


def _nmea(args: argparse.Namespace) -> int:
    from reloc.bridge.nmea import sentences

    def send(pose: "RobotPose", _: "LocalFrame") -> None:
        sys.stdout.write("".join(sentences(pose, args.geoid)))
        sys.stdout.flush()

    count = _passed_on(args, send)
    return _said(f"{count} poses", count)


def _said(text: str, count: int) -> int:
    sys.stderr.write(text + "\n")
    return 0 if count else _NO_POSE
