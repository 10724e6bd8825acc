"""What a server may be told."""

import os
import re
from dataclasses import dataclass, field
from pathlib import Path

from featuredb.errors import InvalidValueError
from featuredb.features.decode import DecodeLimits
from reloc.service.contributions.inbox import InboxOptions
from reloc.service.workers.answering import WorkerLimits
from reloc.tracking.options import TrackOptions
from reloc.wire.keys import DEFAULT_ENDPOINT, NAME_EXPECTED, is_name


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveOptions:
    """Options of the live sessions of one server."""

    # Open at a time; 0 takes none. Following 30 frames a second and matching keyframes take about a core.
    max_sessions: int = 2
    # A session without a usable frame for so long ends: a client that dies is noticed at once, one whose
    # network breaks is not.
    idle_timeout_s: float = 5.0
    # Of a frame; they hold a 4K frame of any quality.
    limits: DecodeLimits = field(
        default_factory=lambda: DecodeLimits(
            max_bytes=8 << 20, max_pixels=16_000_000, max_scan_pixels=160_000_000, max_side_px=8192
        )
    )
    max_side_px: int = 1280  # larger frames are made smaller for tracking, as those of films are
    track: TrackOptions = field(default_factory=lambda: TrackOptions(live=True))  # localises as queries are

    def __post_init__(self) -> None:
        if self.max_sessions < 0:
            raise InvalidValueError(f"LiveOptions.max_sessions: expected >= 0, found {self.max_sessions}")
        for name, value in (("idle_timeout_s", self.idle_timeout_s), ("max_side_px", self.max_side_px)):
            if not value > 0:
                raise InvalidValueError(f"LiveOptions.{name}: expected > 0, found {value}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ServeOptions:
    """Options of one server."""

    listen: tuple[str, ...] = (DEFAULT_ENDPOINT,)  # Zenoh endpoints; port 0 takes a free one
    connect: tuple[str, ...] = ()  # Zenoh endpoints of a router, or another server, that clients connect to
    config_path: Path | None = None  # Zenoh configuration (JSON5); `listen` and `connect` replace what it has
    insecure: bool = False  # start also where whoever reaches the server could answer in its place
    name: str = ""  # of the database on the wire; "": that of its folder
    bbox: tuple[float, float, float, float] | None = None  # W, S, E, N, degrees: only maps that touch it
    metrics_port: int | None = None  # of this machine, for Prometheus; 0 takes a free one, None: no such page
    workers: int = 2  # queries localised at a time, each in a process of its own
    # Of OpenCV and BLAS within one query: all cores, so that a lone query is answered soonest.
    threads_per_worker: int = field(default_factory=lambda: os.cpu_count() or 1)
    # Of one query, or a frame of a live session, beyond the maps; the largest pictures allowed take 1.5 GiB.
    query_memory_bytes: int = 3 * 2**30
    # Queries that may wait; at 0.25 s a query and two workers these take 4 s, half of the deadline.
    max_queue: int = 32  # each waiting query has a timer, which is a thread
    max_queued_bytes: int = 512 * 2**20  # of all waiting payloads together
    # From receipt to answer; under Zenoh's default timeout of 10 s, so that the client hears of it. A worker
    # has half of it for a query, so that those behind the slowest are still answered.
    deadline_s: float = 8.0
    poll_interval_s: float = 1.0  # how often the store is asked for a newer version
    shutdown_grace_s: float = 10.0  # for queries in hand when the server stops
    limits: DecodeLimits = field(default_factory=DecodeLimits)  # of a query's image
    # Take photos that clients give, with credit and licence, into a bounded inbox; nothing of them answers
    # queries before growth has checked them.
    contributions: bool = True
    inbox: InboxOptions = field(default_factory=InboxOptions)
    live: LiveOptions = field(default_factory=LiveOptions)

    @property
    def work_s(self) -> float:
        """The longest that a worker is at one picture."""
        return 0.5 * self.deadline_s

    @property
    def worker_limits(self) -> WorkerLimits:
        """What one picture may use: a query's, or a frame of a live session."""
        return WorkerLimits(
            threads=self.threads_per_worker,
            memory_bytes=self.query_memory_bytes,
            processor_s=self.threads_per_worker * self.work_s,
        )

    def __post_init__(self) -> None:
        counts = ("workers", "threads_per_worker", "query_memory_bytes", "max_queue", "max_queued_bytes")
        for name in (*counts, "deadline_s", "poll_interval_s"):
            if not getattr(self, name) > 0:
                raise InvalidValueError(f"ServeOptions.{name}: expected > 0, found {getattr(self, name)}")
        if self.metrics_port is not None and not 0 <= self.metrics_port < 65_536:
            raise InvalidValueError(
                f"ServeOptions.metrics_port: expected 0..65535, found {self.metrics_port}"
            )
        if self.name:
            check_wire_name(self.name)


def check_wire_name(name: str) -> str:
    """`name`, if it can be one chunk of a Zenoh key. Raises InvalidValueError: it cannot."""
    if not is_name(name):
        raise InvalidValueError(
            f"database name on the wire: {NAME_EXPECTED}, found {name!r}; choose one with --name"
        )
    return name


def wire_name_of(database_url: str) -> str:
    """A name for the wire out of the last part of the database's path or URL."""
    last = re.split(r"[/\\]", database_url.rstrip("/\\"))[-1]
    cleaned = re.sub(r"[^A-Za-z0-9_.-]+", "-", last).strip("-._")[:64]
    return check_wire_name(cleaned or "default")
