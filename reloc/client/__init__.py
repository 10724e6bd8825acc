"""Zenoh client of the relocalisation server."""

from reloc.client.client import BAD_REPLY, NO_SERVER, TIMEOUT, Client, EventStream
from reloc.wire import CameraRequest, LocaliseReply, PriorRequest

__all__ = [
    "BAD_REPLY",
    "NO_SERVER",
    "TIMEOUT",
    "CameraRequest",
    "Client",
    "EventStream",
    "LocaliseReply",
    "PriorRequest",
]
