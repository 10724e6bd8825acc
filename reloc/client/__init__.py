"""Zenoh client of the relocalisation server."""

from reloc.client.client import Client
from reloc.client.events import EventStream
from reloc.client.live import LiveTrack
from reloc.client.replies import BAD_REPLY, NO_SERVER, TIMEOUT
from reloc.wire.query import CameraRequest, LocaliseReply, PriorRequest
from reloc.wire.track import TrackPose

__all__ = [
    "BAD_REPLY",
    "NO_SERVER",
    "TIMEOUT",
    "CameraRequest",
    "Client",
    "EventStream",
    "LiveTrack",
    "LocaliseReply",
    "PriorRequest",
    "TrackPose",
]
