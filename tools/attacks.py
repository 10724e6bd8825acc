"""Attacks on a server and its gateway, by a client with a certificate and by strangers: for the benchmark."""

import itertools
import json
import os
import random
import signal
import socket
import ssl
import struct
import threading
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import zenoh

from tools.serve_process import grandchildren

_AT_ONCE = 8  # questions of the attacker that wait
_SIDE = 10_944  # 120 million pixels, the most that are taken
_CONNECTIONS = 200
STRANGER = "127.0.0.9"  # an address of nobody else


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """What the attacker knows.

    Attributes:
        config: Zenoh configuration of his own certificate, of the client `name`.
        port, gateway: ports of the server and of its gateway, on this machine. pid: of the server.
        database: its name on the wire. photo: that it localises. map_ids: that it answers from.
    """

    config: Path
    name: str
    port: int
    gateway: int
    database: str
    photo: bytes
    map_ids: Sequence[str]
    pid: int

    def key(self, *leaf: str) -> str:
        """Below the attacker's own name."""
        return "/".join(("featuredb", self.database, leaf[0], self.name, *leaf[1:]))


Message = tuple[bytes, bytes | None]  # payload and attachment


def _ask(target: Target, messages: Iterator[Message], at_once: int = _AT_ONCE) -> None:
    """Ask for ever, so many questions at a time."""
    lock, key = threading.Lock(), f"featuredb/*/localise/{target.name}"
    with (
        zenoh.open(zenoh.Config.from_file(str(target.config))) as session,
        ThreadPoolExecutor(at_once) as pool,
    ):

        def run(_: int) -> None:
            while True:
                with lock:
                    payload, attachment = next(messages)
                list(session.get(key, payload=payload, attachment=attachment, timeout=10.0))

        list(pool.map(run, range(at_once)))


def _pngs(target: Target, bits: int, colour: int) -> None:
    """As many pixels as are taken, in a small file."""
    bytes_a_pixel = 8 if bits == 16 else 1
    pixels = zeros((_SIDE * bytes_a_pixel + 1) * _SIDE)
    _ask(target, itertools.repeat((png(_SIDE, _SIDE, pixels, bits=bits, colour=colour), None)))


def _scans(target: Target) -> None:
    """JPEGs with as many scans as are taken, and with more."""
    _ask(target, itertools.cycle([(progressive_jpeg(_SIDE, scans), None) for scans in (10, 80)]))


def _truncated(target: Target) -> None:
    step = len(target.photo) // 20
    _ask(target, itertools.cycle([(target.photo[: k * step], None) for k in range(1, 20)]))


def _hostile(target: Target) -> None:
    attachments = [
        b"[" * 60_000,
        b'{"options": {"maps": [' + b'"a",' * 10_000 + b'"a"]}}',
        b'{"prior": {"lat": 1e400, "lon": NaN, "sigma_m": 1}}',
        b'{"camera": {"model": "PINHOLE", "width": 1, "height": 1, "params": [1e308, 1e308, 0, 0]}}',
        b'{"prior": {"lat": 0, "lon": 0, "sigma_m": 1e300}}',
        json.dumps({"options": {"inliers": True}, "request_id": "x" * 10_000}).encode(),
        bytes(60_000),
    ]
    _ask(target, itertools.cycle([(target.photo, a) for a in attachments]))


def _parts(target: Target) -> None:
    """Each question names other maps of the area."""
    rng = random.Random(1)

    def messages() -> Iterator[Message]:
        while True:
            some = rng.sample(list(target.map_ids), len(target.map_ids) // 2)
            yield target.photo, json.dumps({"options": {"maps": some}}).encode()

    _ask(target, messages())


def _flood(target: Target) -> None:
    """Good photos, as many as go."""
    _ask(target, itertools.repeat((target.photo, None)), at_once=64)


def _kills(target: Target) -> None:
    """A worker is killed every two seconds, whatever it does."""
    while True:
        time.sleep(2.0)
        os.kill(random.choice(grandchildren(target.pid)), signal.SIGKILL)


def _connections(target: Target) -> None:
    """Connections to server and gateway, closed again: half say nothing, half begin to speak TLS."""
    hello = client_hello()
    while True:
        held = [
            connected("127.0.0.1", port, STRANGER)
            for port in (target.port, target.gateway)
            for _ in range(_CONNECTIONS)
        ]
        for connection in held[::2]:
            _say(connection, hello)
        time.sleep(5.0)
        for connection in held:
            connection.close()


def _dripping(target: Target) -> None:
    """Photos to the gateway, a byte a second."""
    head = (
        b"POST /localise HTTP/1.1\r\nHost: x\r\nContent-Type: multipart/form-data; boundary=b\r\n"
        b"Content-Length: 1000000\r\n\r\n"
    )
    while True:
        held = [connected("127.0.0.1", target.gateway) for _ in range(_CONNECTIONS)]
        for connection in held:
            _say(connection, head)
        for _ in range(20):
            for connection in held:
                _say(connection, b"-")
            time.sleep(1.0)
        for connection in held:
            connection.close()


def _frames(target: Target) -> None:
    """Live sessions whose frames are bombs, more than there may be."""
    bomb = png(4000, 4000, zeros((4000 * 8 + 1) * 4000), bits=16, colour=6)
    with zenoh.open(zenoh.Config.from_file(str(target.config))) as session:
        for turn in itertools.count():
            keys = [target.key("track", f"{turn}-{k}") for k in range(4)]
            tokens = [session.liveliness().declare_token(f"{key}/client") for key in keys]
            for key in keys:
                list(session.get(key, timeout=2.0))
            for sequence in range(30):
                header = json.dumps({"sequence": sequence, "time_s": float(sequence)}).encode()
                for key in keys:
                    session.put(f"{key}/frames", bomb, attachment=header)
                time.sleep(0.2)
            for token in tokens:
                token.undeclare()


def client_hello() -> bytes:
    """What a client of TLS says first."""
    received, sent = ssl.MemoryBIO(), ssl.MemoryBIO()
    with suppress(ssl.SSLWantReadError):
        ssl.create_default_context().wrap_bio(received, sent, server_hostname="localhost").do_handshake()
    return sent.read()


def connected(host: str, port: int, source: str = "") -> socket.socket:
    """A socket that is connected, if there was room, from the address `source`."""
    made = socket.socket()
    made.settimeout(1.0)
    with suppress(OSError):  # no room for it: as good
        made.bind((source, 0))
        made.connect((host, port))
    return made


def _say(connection: socket.socket, data: bytes) -> None:
    with suppress(OSError):
        connection.sendall(data)


ATTACKS: dict[str, Callable[[Target], None]] = {
    "large PNG": partial(_pngs, bits=8, colour=0),
    "deep PNG": partial(_pngs, bits=16, colour=6),  # 960 MB of pixels in 1 MB
    "JPEG of many scans": _scans,
    "truncated photos": _truncated,
    "hostile messages": _hostile,
    "parts of an area": _parts,
    "flood by one identity": _flood,
    "bombs as live frames": _frames,
    "dripping connections": _dripping,
    "workers killed": _kills,
    "200 connections": _connections,
}


def png(width: int, height: int, pixels: bytes, *, bits: int = 8, colour: int = 0) -> bytes:
    """A PNG with this header and these pixels, compressed as `zeros` are, all check sums right."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def zeros(size: int) -> bytes:
    """At least so many bytes 0, as zlib packs them: a block again and again."""
    block = bytes(1 << 20)
    packer = zlib.compressobj(9)
    head = packer.compress(block) + packer.flush(zlib.Z_FULL_FLUSH)
    again = packer.compress(block) + packer.flush(zlib.Z_FULL_FLUSH)
    count = -(-size // len(block))
    # Adler's sums of bytes 0: the first stays 1, the second counts them.
    total = (count * len(block) % 65_521) << 16 | 1
    return head + (count - 1) * again + b"\x03\x00" + struct.pack(">I", total)


def progressive_jpeg(side: int, scans: int) -> bytes:
    """A grey progressive JPEG of side x side pixels (a multiple of 32) with so many scans (2 to 127).

    The first scan has a bit for each block, the others a few for all of them; each is a pass over all.
    """
    blocks = (side // 8) ** 2

    def segment(marker: int, body: bytes) -> bytes:
        return struct.pack(">BBH", 0xFF, marker, 2 + len(body)) + body

    def huffman(kind: int, symbol: int) -> bytes:
        return segment(0xC4, bytes([kind << 4, 1, *[0] * 15, symbol]))  # its only code is the bit 0

    def scan(first: int, last: int, approximation: int, bits: int) -> bytes:
        return segment(0xDA, bytes([1, 1, 0, first, last, approximation])) + bytes(-(-bits // 8))

    out = [b"\xff\xd8", segment(0xDB, bytes([0, *[1] * 64]))]
    out.append(segment(0xC2, struct.pack(">BHHB", 8, side, side, 1) + bytes([1, 0x11, 0])))
    out += [huffman(0, 0x00), huffman(1, 0xE0)]  # no difference; nothing in the next 16,384 blocks
    out.append(scan(0, 0, 0x00, blocks))
    for number in range(scans - 1):
        coefficient = 1 + number % 63
        out.append(scan(coefficient, coefficient, 0x01 if number < 63 else 0x10, 15 * -(-blocks // 16_384)))
    return b"".join(out) + b"\xff\xd9"
