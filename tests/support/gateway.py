"""A real gateway on a free loopback port, in a thread of the test."""

import base64
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import requests

from reloc.gateway.app import Gateway
from reloc.gateway.options import GatewayOptions
from reloc.gateway.serve import listen, uvicorn_server

NOW_MS = 1_764_000_000_000
_PRIVACY: dict[str, list[str]] = {
    "dataRetention": [],
    "dataAcceptableUse": [],
    "dataSanitizationApplied": [],
    "dataSanitizationRequested": [],
}


@dataclass(frozen=True)
class RunningGateway:
    url: str
    port: int
    state: Gateway

    def get(self, path: str) -> requests.Response:
        return requests.get(self.url + path, timeout=30)

    def post(self, path: str, **arguments: Any) -> requests.Response:
        return requests.post(self.url + path, timeout=30, **arguments)


@contextmanager
def running_gateway(connect: str, **options: Any) -> Iterator[RunningGateway]:
    """A gateway that asks the server at a Zenoh endpoint."""
    chosen = GatewayOptions(connect=connect, port=0, **options)
    with listen(chosen) as bound:
        port = int(bound.getsockname()[1])
        server = uvicorn_server(chosen)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]})
        thread.start()
        try:
            end = time.monotonic() + 20.0
            while not server.started:
                assert thread.is_alive(), "the gateway did not start"
                assert time.monotonic() < end, "the gateway did not start in time"
                time.sleep(0.01)
            yield RunningGateway(
                f"http://127.0.0.1:{port}{chosen.prefix}", port, server.config.app.state.gateway
            )
        finally:
            server.should_exit = True
            thread.join(30.0)
            assert not thread.is_alive(), "the gateway does not stop"


def geopose_request(image: bytes | str, **camera: Any) -> dict[str, Any]:
    """A request as the protocol's clients send it; `camera` adds to the picture's reading."""
    return {
        "id": "d9fbf438-b7c6-419a-a75b-1cf79275e58d",
        "timestamp": NOW_MS,
        "type": "geopose",
        "sensors": [{"id": "0", "type": "camera"}, {"id": "1", "type": "geolocation"}],
        "sensorReadings": {
            "cameraReadings": [
                {
                    "timestamp": NOW_MS - 32,
                    "sensorId": "0",
                    "privacy": _PRIVACY,
                    "sequenceNumber": 0,
                    "imageFormat": "JPG",
                    "size": [160, 120],
                    "imageBytes": image if isinstance(image, str) else base64.b64encode(image).decode(),
                    "imageOrientation": {"mirrored": False, "rotation": 0},
                    **camera,
                }
            ],
        },
    }


def geolocation(lat: float, lon: float, accuracy: float, timestamp: float = NOW_MS - 32) -> dict[str, Any]:
    """A reading as the protocol has it."""
    return {
        "timestamp": timestamp,
        "sensorId": "1",
        "privacy": _PRIVACY,
        "latitude": lat,
        "longitude": lon,
        "altitude": 0,
        "accuracy": accuracy,
        "altitudeAccuracy": 0,
        "heading": 0,
        "speed": 0,
    }
