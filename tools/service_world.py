"""What studies of the service ask: a real map, made larger, a server with keys, and honest clients."""

import argparse
import io
import os
import shutil
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from featuredb.errors import ServiceError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geo.utm import utm_epsg
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from reloc.authority import Authority
from reloc.client import Client, LocaliseReply
from reloc.service.session import bind_free_port
from tools.commands import first_map
from tools.figures import study_parser
from tools.serve_process import CommandProcess, ServeProcess, beside

HONEST, ATTACKER, WEB = ("alice", "bob", "carol"), "mallory", "web"
_SAME_M = 0.5  # two answers to one photo
_SIDE_PX = 1024  # longer one of what is sent
_PAUSE_S = 1.0  # of an honest client
DEADLINE_S = 8.0  # of a query

CONFIG = Path(__file__).parents[1] / "deploy/haproxy.cfg"
_START_S = 10.0


@contextmanager
def proxied(port: int, behind: int) -> Iterator[None]:
    """Within the block who connects to `port` comes to the server at `behind`, both of 127.0.0.1.

    Raises RuntimeError: HAProxy is not installed, or does not start.
    """
    if shutil.which("haproxy") is None:
        raise RuntimeError("haproxy is not installed; expected it as by apt-get install haproxy")
    env = {"FEATUREDB_BIND": f"127.0.0.1:{port}", "FEATUREDB_SERVER": f"127.0.0.1:{behind}"}
    process = subprocess.Popen(["haproxy", "-q", "-db", "-f", str(CONFIG)], env={**os.environ, **env})
    try:
        _wait_for(process, port)
        yield
    finally:
        process.terminate()
        process.wait()


def _wait_for(process: subprocess.Popen[bytes], port: int) -> None:
    end = time.monotonic() + _START_S
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port), 1.0).close()
        except OSError as error:
            if process.poll() is not None or time.monotonic() > end:
                raise RuntimeError(f"haproxy does not listen on 127.0.0.1:{port}") from error
            time.sleep(0.05)


def service_parser(doc: str | None) -> argparse.ArgumentParser:
    """What all of these studies are told; `doc`: of the program's module."""
    parser = study_parser(doc)
    parser.add_argument("db", type=Path)
    parser.add_argument("photos", type=Path, help="folder of the map's photos")
    return parser


def enlarged(database: Database, points: int) -> list[str]:
    """Copies of the oldest map, each beside the last, until the database has so many points; all map ids."""
    original = first_map(database)
    database.commit_maps([moved(original, k) for k in range(1, -(-points // len(original.points)))])
    return [m.map_id for m in database.snapshot().maps()]


def moved(original: FeatureMap, number: int) -> FeatureMap:
    """A copy beside it."""
    step = 200.0 * np.array([number % 4, number // 4, 0.0])
    origin = original.frame.utm_from_enu(np.zeros(3), original.epsg) + step
    frame = LocalFrame.from_utm(*origin.tolist(), original.epsg)
    return copied_map(original, frame, number, f"{original.map_id}-moved-{number}")


def copied_map(source: FeatureMap, frame: LocalFrame, number: int, map_id: str) -> FeatureMap:
    """The map at another place, with descriptors as real as its own: their cells are in another order."""
    epsg, seen = utm_epsg(frame.latitude_deg, frame.longitude_deg), source.observations
    return replace(
        source,
        map_id=map_id,
        name=map_id,
        frame=frame,
        epsg=epsg,
        points=replace(source.points, utm=frame.utm_from_enu(source.points_local(), epsg)),
        observations=replace(seen, descriptors=seen.descriptors[:, cell_order(number)]),
    )


def cell_order(copy: int) -> NDArray[np.int64]:
    """(128,) another order of a descriptor's 4 x 4 cells, the first its own; corners, edges and inner cells,
    of different weights in SIFT, change places among themselves."""
    rng = np.random.default_rng(copy)
    cells = np.arange(16)
    inner = sum((at % 3 > 0).astype(np.int64) for at in np.divmod(cells, 4))
    if copy:
        for kind in range(3):
            alike = np.flatnonzero(inner == kind)
            cells[alike] = rng.permutation(alike)
    return (cells[:, None] * 8 + np.arange(8)).ravel()


def photos_of(folder: Path, count: int) -> list[bytes]:
    """Photos as an app sends them: made smaller, with their EXIF."""
    found = []
    for path in sorted(folder.glob("*.JPG"))[:count]:
        with Image.open(path) as photo:
            exif = photo.info["exif"]
            photo.thumbnail((_SIDE_PX, _SIDE_PX))
            out = io.BytesIO()
            photo.save(out, "JPEG", quality=90, exif=exif)
            found.append(out.getvalue())
    return found


def free_port() -> int:
    """One that nobody listens on now."""
    return int(bind_free_port("tcp/127.0.0.1:0").rpartition(":")[2])


@dataclass(frozen=True, slots=True, kw_only=True)
class Service:
    """A server with keys, and a gateway before it.

    Attributes:
        keys: the authority's folder. port: of the proxy. photos: that clients ask.
        expected: answers when nobody else asks: to each photo with its position, then to each without.
    """

    server: ServeProcess
    gateway: CommandProcess
    keys: Path
    port: int
    photos: Sequence[bytes]
    expected: list[LocaliseReply] = field(default_factory=list)

    def config(self, client: str) -> Path:
        return self.keys / "clients" / f"{client}.json5"


@contextmanager
def running_service(database: Path, photos: Sequence[bytes]) -> Iterator[Service]:
    """As `featuredb keys` ships it, behind the proxy of `deploy/`; all end by SIGTERM."""
    port, behind = free_port(), free_port()
    with ExitStack() as stack:
        keys = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "keys"
        authority = Authority.create(keys, port=port)
        for name in (*HONEST, ATTACKER, WEB):
            authority.add_client(name)
        words = ("--config", keys / "server.json5", "--listen", f"tls/127.0.0.1:{behind}")
        server = ServeProcess(database, *words, "--deadline", DEADLINE_S)
        stack.callback(server.stop)
        stack.enter_context(proxied(port, behind))
        words = ("--config", keys / f"clients/{WEB}.json5", "--port", free_port())
        gateway = CommandProcess("gateway", *words, "--timeout", DEADLINE_S)
        stack.callback(gateway.stop)
        service = Service(server=server, gateway=gateway, keys=keys, port=port, photos=photos)
        with Client(config_path=service.config(HONEST[0])) as client:
            for prior, photo in product((True, False), photos):
                service.expected.append(client.localise(photo, exif_prior=prior, timeout_s=60.0))
        yield service


@dataclass(slots=True)
class Heard:
    """What honest clients were answered; threads share it.

    Attributes:
        seconds: of each question, failed ones as long as they may take. failures: codes.
        same: of each answer, whether it is that of the first one to the same question.
    """

    seconds: list[float] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    same: list[bool] = field(default_factory=list)

    @property
    def wrong(self) -> int:
        return self.same.count(False)

    def failed(self, code: str) -> None:
        self.seconds.append(DEADLINE_S)
        self.failures.append(code)

    def p99_s(self) -> float:
        return float(np.percentile(self.seconds, 99)) if self.seconds else float("nan")


def same_place(reply: LocaliseReply, expected: LocaliseReply) -> bool:
    """Whether two answers to one photo agree."""
    if reply.utm is None or expected.utm is None:
        return reply.utm is expected.utm
    a, b = ((u.easting, u.northing, u.height) for u in (reply.utm, expected.utm))
    return float(np.linalg.norm(np.subtract(a, b))) < _SAME_M


@contextmanager
def honest_clients(service: Service) -> Iterator[Heard]:
    """Within the block each honest client asks again and again, after a pause; one of them anew connected.

    Every other question comes without a prior: it is looked for in all maps.
    """
    heard, stop = Heard(), threading.Event()
    photos, expected = service.photos, service.expected

    def ask(client: Client, number: int) -> None:
        which = number % len(expected)
        start = time.monotonic()
        try:
            photo, prior = photos[which % len(photos)], which < len(photos)
            reply = client.localise(photo, exif_prior=prior, timeout_s=DEADLINE_S)
        except ServiceError as error:
            heard.failed(error.code)
        else:
            heard.seconds.append(time.monotonic() - start)
            heard.same.append(same_place(reply, expected[which]))

    def run(name: str, number: int) -> None:
        path, again = service.config(name), name == HONEST[-1]
        while not stop.is_set():
            try:
                with Client(config_path=path) as client:
                    while not stop.is_set():
                        ask(client, number)
                        number += 5
                        stop.wait(_PAUSE_S)
                        if again:
                            break
            except ServiceError as error:  # it cannot connect
                heard.failed(error.code)

    threads = [threading.Thread(target=run, args=(name, 3 * k)) for k, name in enumerate(HONEST)]
    with beside(threads, stop):
        yield heard
