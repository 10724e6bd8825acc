"""A real server on loopback with a localiser whose behaviour the test controls."""

import io
import multiprocessing
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from multiprocessing import connection as mp

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from featuredb.geo.geopose import geopose_from_camera
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import quaternion_from_matrix
from featuredb.store.candidates.photos import InboxCounts
from featuredb.store.candidates.states import Contribution
from reloc.client import Client
from reloc.localise.candidates import IndexedArea
from reloc.localise.options import LocaliseOptions
from reloc.localise.result import LocalisedPose, LocaliseRequest, LocaliseResult
from reloc.service.contributions.inbox import Inbox
from reloc.service.options import ServeOptions
from reloc.service.server import Server
from reloc.service.source import ServedArea
from reloc.wire.query import InlierPoints, Lineage, RunnerUpPose
from reloc.wire.server import BoundingBox, MapInfo

EPSG = 32632
EASTING, NORTHING, HEIGHT = 456_800.0, 5_429_300.0, 120.0


def localised(snapshot: int, camera: Camera, *, want_inliers: bool = False) -> LocaliseResult:
    """A result like a real one: a tilted camera 30 m beside and 50 m above the frame's origin."""
    frame = LocalFrame.from_utm(EASTING, NORTHING, HEIGHT, EPSG)
    rotation = Rigid3.exp([2.3, 0.2, -0.1, 0, 0, 0]).rotation
    cam_from_local = Rigid3(rotation=rotation, translation=-rotation @ np.array([30.0, -20.0, 50.0]))
    inliers = InlierPoints(
        pixels=((10.5, 20.25), (100.0, 50.0)),
        utm=((EASTING, NORTHING, HEIGHT), (EASTING + 5.5, NORTHING - 3.25, HEIGHT)),
        map_rows=(0, 0),
    )
    pose = LocalisedPose(
        frame=frame,
        cam_from_local=cam_from_local,
        covariance=np.diag([1e-6] * 3 + [0.01] * 3),
        camera=camera,
        camera_source="exif",
        epsg=EPSG,
        utm=frame.utm_from_enu(cam_from_local.center, EPSG),
        cam_from_utm_xyzw=quaternion_from_matrix(rotation),
        geopose=geopose_from_camera(cam_from_local, frame),
        height_datum="ellipsoidal",
        map_ids=("map-a",),
        lineage=(Lineage(map_id="map-a", method="gps", generation=0, parents=()),),
        residual_rms_px=0.8,
        inliers=inliers if want_inliers else None,
    )
    runner_up = RunnerUpPose(inliers=9, distance_m=40.0, angle_deg=170.0, lat=49.0, lon=8.4)
    return LocaliseResult(
        reason=None,
        detail="1 map",
        pose=pose,
        confidence=0.99,
        features=2000,
        matches=150,
        inliers=120,
        runner_up=runner_up,
        snapshot=snapshot,
        timings_ms={"extract": 1.0, "match": 0.5},
    )


def not_localised(snapshot: int) -> LocaliseResult:
    return LocaliseResult(
        reason="TOO_FEW_INLIERS",
        detail="7 of 12 needed",
        pose=None,
        confidence=0.0,
        features=500,
        matches=30,
        inliers=7,
        runner_up=None,
        snapshot=snapshot,
        timings_ms={"extract": 1.0},
    )


class ScriptedLocaliser:
    """Answers from a function of its own; records what it was asked."""

    areas: tuple[IndexedArea, ...] = ()
    options = LocaliseOptions()

    def __init__(
        self,
        snapshot: int,
        answer: Callable[[NDArray[np.uint8], LocaliseRequest], LocaliseResult] | None = None,
    ) -> None:
        self.snapshot = snapshot
        self.requests: list[LocaliseRequest] = []
        self.grays: list[NDArray[np.uint8]] = []
        self._answer = answer
        self._listener: mp.Listener | None = None

    def __reduce__(self) -> tuple[object, ...]:
        """In a worker process it stands for this one, which is asked over a socket."""
        if self._listener is None:
            self._listener = mp.Listener(authkey=multiprocessing.current_process().authkey)
            threading.Thread(target=self._serve, args=(self._listener,), daemon=True).start()
        authkey = bytes(multiprocessing.current_process().authkey)
        return _Remote, (self._listener.address, authkey, self.snapshot, self.areas)

    def _serve(self, listener: mp.Listener) -> None:
        while True:
            connection = listener.accept()
            threading.Thread(target=self._serve_one, args=(connection,), daemon=True).start()

    def _serve_one(self, connection: mp.Connection) -> None:
        with connection:
            try:
                answer: object = self.localise(*connection.recv())
            except Exception as error:  # noqa: BLE001  # raised in the worker
                answer = error
            with suppress(OSError):  # the worker may have been killed meanwhile
                connection.send(answer)

    def localise(
        self, gray: NDArray[np.uint8], request: LocaliseRequest, size: tuple[int, int]
    ) -> LocaliseResult:
        self.requests.append(request)
        self.grays.append(gray)
        if self._answer is not None:
            return self._answer(gray, request)
        height, width = gray.shape
        camera = request.camera or Camera.from_focal(width, height, 1.2 * width)
        return localised(self.snapshot, camera, want_inliers=request.want_inliers)


class _Remote:
    """A `ScriptedLocaliser` of the test's process, in a worker."""

    options = LocaliseOptions()

    def __init__(self, address: str, authkey: bytes, snapshot: int, areas: tuple[IndexedArea, ...]) -> None:
        self.areas, self.snapshot, self._address, self._authkey = areas, snapshot, address, authkey

    def localise(
        self, gray: NDArray[np.uint8], request: LocaliseRequest, size: tuple[int, int]
    ) -> LocaliseResult:
        with mp.Client(self._address, authkey=self._authkey) as connection:
            connection.send((gray, request, size))
            answer = connection.recv()
        if isinstance(answer, Exception):
            raise answer
        return answer


class Gate:
    """Holds whoever passes until it is opened; `entered` counts arrivals."""

    def __init__(self) -> None:
        self.entered = threading.Semaphore(0)
        self._open = threading.Event()

    def wait(self) -> None:
        self.entered.release()
        assert self._open.wait(30.0), "the test never opened the gate"

    def open(self) -> None:
        self._open.set()


class MemorySource:
    """An area source whose version the test moves."""

    def __init__(self, area: ServedArea) -> None:
        self.area = area
        self.newest = area.snapshot
        self.failure: Exception | None = None
        self.loads = 0

    def version(self) -> int:
        return self.newest

    def load(self) -> ServedArea:
        self.loads += 1
        if self.failure is not None:
            raise self.failure
        return self.area

    def publish(self, area: ServedArea) -> None:
        self.area = area
        self.newest = area.snapshot


class MemoryInbox:
    """Where contributions go in tests that need no database; may be held up or made to fail."""

    def __init__(self) -> None:
        self.written: list[Contribution] = []
        self.stored = InboxCounts(by_state={}, waiting_by_owner={}, stored_bytes=0)
        self.failure: Exception | None = None
        self.gate: Gate | None = None
        self.attempts = 0
        self.counted = 0

    def write(self, contributions: list[Contribution]) -> None:
        self.attempts += 1
        if self.gate is not None:
            self.gate.wait()
        if self.failure is not None:
            raise self.failure
        self.written += contributions

    def counts(self) -> InboxCounts:
        self.counted += 1
        return self.stored


def map_info(map_id: str = "map-a", digest: str = "d0") -> MapInfo:
    return MapInfo(
        map_id=map_id,
        content_digest=digest,
        name=f"name of {map_id}",
        epsg=EPSG,
        height_datum="ellipsoidal",
        method="gps",
        generation=0,
        images=14,
        points=5000,
        bounds=BoundingBox(west=8.3, south=49.0, east=8.4, north=49.1),
        tiles=(f"{EPSG}-E000892_N010604",),
    )


def area_of(localiser: ScriptedLocaliser, *maps: MapInfo) -> ServedArea:
    return ServedArea(localiser=localiser, maps=maps or (map_info(),))


@contextmanager
def running_server(
    localiser_or_source: ScriptedLocaliser | MemorySource,
    options: ServeOptions | None = None,
    name: str = "town",
    inbox: Inbox | None = None,
) -> Iterator[Server]:
    """A server on a free loopback port."""
    source = localiser_or_source
    if isinstance(source, ScriptedLocaliser):
        source = MemorySource(area_of(source))
    options = replace(options or ServeOptions(), listen=("tcp/127.0.0.1:0",))
    with Server.start(source, options, name, inbox) as server:
        yield server


@contextmanager
def client_of(server: Server) -> Iterator[Client]:
    with Client(server.endpoints[0], server.database) as client:
        yield client


def photo(fmt: str = "JPEG", size: tuple[int, int] = (160, 120), seed: int = 0, **save: object) -> bytes:
    """Bytes of a small picture of blurred noise."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (size[1] // 4, size[0] // 4, 3), dtype=np.uint8)
    out = io.BytesIO()
    Image.fromarray(coarse).resize(size, Image.Resampling.BICUBIC).save(out, fmt, **save)
    return out.getvalue()
