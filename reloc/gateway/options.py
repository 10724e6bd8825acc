"""What a gateway may be told."""

import re
from dataclasses import dataclass, fields
from pathlib import Path

from featuredb.errors import InvalidValueError
from reloc.wire.keys import DEFAULT_ENDPOINT

_PREFIX = re.compile(r"(/[A-Za-z0-9._~-]+)*")


@dataclass(frozen=True, slots=True, kw_only=True)
class GatewayOptions:
    """Options of one gateway."""

    connect: str = DEFAULT_ENDPOINT  # Zenoh endpoint of the server
    config_path: Path | None = None  # a Zenoh configuration instead of it
    database: str | None = None  # name on the wire; None takes the only one that is served there
    host: str = "127.0.0.1"
    port: int = 8080  # 0 takes a free one
    insecure: bool = False  # listen also where other machines reach it, without TLS or knowing who asks
    prefix: str = ""  # stands before every path, such as "/vps"
    timeout_s: float = 10.0  # the longest wait for the server's answer to one photo; Zenoh's own default
    connect_timeout_s: float = 2.0  # the longest wait for a server to be there
    max_in_flight: int = 16  # photos in hand at a time, from the end of their bodies on
    max_body_bytes: int = 90 << 20  # of one request; images of 64 MiB are 85.4 MiB as base64
    max_image_bytes: int = 64 << 20  # of one image after base64, as the server takes them
    max_buffered_bytes: int = 512 << 20  # of all bodies in hand together
    body_timeout_s: float = 30.0  # for a body to arrive
    # One standard deviation. No position of a client is trusted more closely than the first: phones between
    # houses are off by tens of metres and claim three. The second is of positions without an accuracy.
    prior_floor_m: float = 10.0
    prior_unknown_m: float = 50.0
    cors_origins: tuple[str, ...] = ()  # web pages of these origins may ask; "*" is all

    def __post_init__(self) -> None:
        for name in (field.name for field in fields(self) if field.type in (int, float)):
            if name != "port" and not getattr(self, name) > 0:
                raise InvalidValueError(f"GatewayOptions.{name}: expected > 0, found {getattr(self, name)}")
        if not 0 <= self.port <= 65_535:
            raise InvalidValueError(f"GatewayOptions.port: expected 0..65535, found {self.port}")
        if not _PREFIX.fullmatch(self.prefix):
            raise InvalidValueError(
                f"GatewayOptions.prefix: expected a path such as /vps, without a slash at its end, found "
                f"{self.prefix!r}"
            )
