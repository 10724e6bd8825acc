"""Zenoh client of the relocalisation server."""

from reloc.client.client import Client
from reloc.client.connection import BAD_REPLY, NO_SERVER, TIMEOUT
from reloc.client.live import LiveTrack
from reloc.wire.query import CameraRequest, LocaliseReply, PriorRequest
from reloc.wire.track import TrackPose

__all__ = [
    "BAD_REPLY",
    "NO_SERVER",
    "TIMEOUT",
    "CameraRequest",
    "Client",
    "LiveTrack",
    "LocaliseReply",
    "PriorRequest",
    "TrackPose",
]
