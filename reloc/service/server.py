"""The relocalisation server: Zenoh in front, workers behind, the store watched."""

import json
import logging
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from typing import Self

import zenoh
from pydantic import BaseModel

from reloc.service.contributions.inbox import Inbox
from reloc.service.live.session import Follower
from reloc.service.live.sessions import LiveSessions
from reloc.service.logs import Tally, fields
from reloc.service.options import ServeOptions
from reloc.service.queueing import PendingQuery, QueryQueue
from reloc.service.session import (
    JSON,
    ServiceStartError,
    authenticates,
    bind_free_port,
    check_exposure,
    open_server_session,
    publish,
    server_config,
)
from reloc.service.source import DatabaseSource, ServedArea
from reloc.service.workers.pool import WorkerPool
from reloc.service.workers.process import prepare_workers
from reloc.wire.keys import Keys, client_of, is_addressed
from reloc.wire.query import MESSAGE_HEADROOM, WIRE_VERSION, ErrorCode, RequestError, encode
from reloc.wire.server import (
    Event,
    EventType,
    Latency,
    Limits,
    MapsReply,
    QueryCounts,
    QueueStatus,
    ReloadStatus,
    StatusReply,
)

logger = logging.getLogger(__name__)

_MAX_RETRY_S = 60.0  # a broken snapshot is tried again, ever less often up to this


class Server:
    """A running server; `start` makes one, `close` (or leaving the `with` block) ends it."""

    def __init__(
        self,
        source: DatabaseSource,
        options: ServeOptions,
        database: str,
        inbox: Inbox | None,
        area: ServedArea,
        session: zenoh.Session,
        endpoints: tuple[str, ...],
        *,
        authenticates: bool,
    ) -> None:
        self.database = database  # its name on the wire
        self.endpoints = endpoints  # where it listens; empty where only the configuration file knows
        self.server_id = str(session.zid())
        self._session = session
        self._options = options
        self._authenticates = authenticates
        self._keys = Keys(database=database)
        self._area = area
        self._started = time.perf_counter()
        self._tally = Tally()
        self._reloads = 0
        self._reload_error: str | None = None
        self._queue = QueryQueue(options.max_queue, options.max_queued_bytes)
        self._inbox = inbox
        self._workers = WorkerPool(self._queue, options, inbox)
        self._source = source
        self._watcher = threading.Thread(target=self._watch, name="area-watcher", daemon=True)
        self._watched = threading.Event()  # enough
        self._live = LiveSessions(
            session,
            self._keys,
            lambda: self._area,
            lambda answerer: Follower(answerer, options, lambda: self._workers.published),
            options.live,
            self.server_id,
            authenticates=authenticates,
        )
        self._declared = ExitStack()
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._token_lock = threading.Lock()
        self._closed = False

    @classmethod
    def start(
        cls, source: DatabaseSource, options: ServeOptions, database: str, inbox: Inbox | None = None
    ) -> Self:
        """Listen, then load the area; when this returns, queries are answered.

        Without an inbox, which the server starts and closes, it takes no contributed photos.

        Raises:
            ServiceStartError: cannot listen, or strangers could reach it and `insecure` is not set.
            FeatureDbError: the area cannot be loaded.
        """
        config = server_config(
            options.listen, options.connect, options.config_path, MESSAGE_HEADROOM * options.limits.max_bytes
        )
        if not options.insecure:
            check_exposure(config)
        endpoints = tuple(bind_free_port(endpoint) for endpoint in options.listen)
        if endpoints:
            config.insert_json5("listen/endpoints", json.dumps(endpoints))
        # Before the area, which takes long. Until the server has a token, clients wait for it.
        session = open_server_session(config, ", ".join(endpoints) or str(options.config_path))
        try:
            prepare_workers()
            area = source.load()
        except BaseException:
            session.close()
            raise
        proven = authenticates(config)
        server = cls(source, options, database, inbox, area, session, endpoints, authenticates=proven)
        try:
            server._declare()
        except zenoh.ZError as error:
            raise ServiceStartError(f"cannot declare the keys of {database!r}: {error}") from error
        return server

    def _declare(self) -> None:
        """Start all parts; those that have begun end again where another one cannot."""
        with ExitStack() as undo:
            undo.callback(self._session.close)
            if self._inbox is not None:
                self._inbox.start()
                undo.callback(self._inbox.close, 0.0)
            undo.callback(self._queue.close)
            self._workers.publish(self._area)
            self._workers.start()
            self._listen()
            undo.pop_all()

    def _listen(self) -> None:
        # `complete`: of several servers of one database the nearest answers, not all of them. One that has a
        # part of it answers who asks it by its id, and has no live sessions: others may have the place.
        whole = self._options.bbox is None
        answers: dict[str, Callable[[zenoh.Query], None]] = {
            self._keys.localise("*", self.server_id): self._on_localise,
            self._keys.of("status"): partial(self._say, "status", self.status),
            self._keys.of("maps"): partial(self._say, "maps", self._maps),
        }
        if whole:
            answers[self._keys.localise("*")] = self._on_localise
        for key, callback in answers.items():
            self._declared.enter_context(self._session.declare_queryable(key, callback, complete=True))
        if whole:
            self._live.start()
        self._advertise(self._area)  # after the queryables: who sees the token can ask at once
        self._watcher.start()
        self._log("serving", snapshot=self._area.snapshot, maps=len(self._area.maps), listen=self.endpoints)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failed: object) -> None:
        self.close()

    def close(self) -> None:
        """Take no more queries, answer those in hand, say goodbye. The second call does nothing."""
        if self._closed:
            return
        self._closed = True
        self._publish("stopping", detail="the server is stopping")
        with self._token_lock:
            for token in self._tokens.values():
                token.undeclare()
            self._tokens.clear()
        self._queue.close()
        self._live.close(self._options.shutdown_grace_s)
        left = self._workers.join(self._options.shutdown_grace_s)
        for item in (*self._queue.drain(), *left):
            item.refuse(RequestError(ErrorCode.SHUTTING_DOWN, "the server stopped before it could answer"))
            self._workers.abandon(item)
        self._declared.close()
        if self._inbox is not None:
            self._inbox.close(self._options.shutdown_grace_s)
        self._watched.set()
        self._watcher.join(self._options.shutdown_grace_s)
        self._session.close()
        self._log("stopped", queries=self._queries().model_dump())

    def status(self) -> StatusReply:
        """What `.../status` answers."""
        options, area = self._options, self._area
        return StatusReply(
            database=self.database,
            server_id=self.server_id,
            version=version("featuredb"),
            wire_version=WIRE_VERSION,
            snapshot=area.snapshot,
            maps=len(area.maps),
            uptime_s=round(time.perf_counter() - self._started, 3),
            queue=QueueStatus(
                length=len(self._queue),
                capacity=options.max_queue,
                workers=options.workers,
                busy=self._workers.busy,
                ready=self._workers.ready,
            ),
            queries=self._queries(),
            latency_ms=Latency(**self._tally.latency(50, 90, 99)),
            reload=ReloadStatus(count=self._reloads, error=self._reload_error),
            limits=Limits(
                max_payload_bytes=options.limits.max_bytes,
                max_pixels=options.limits.max_pixels,
                deadline_s=options.deadline_s,
            ),
            contributions=None if self._inbox is None else self._inbox.status(),
            live=self._live.status(),
            part="" if options.bbox is None else ",".join(map(repr, options.bbox)),
            bounds=area.bounds,
            addressable=True,
        )

    def _queries(self) -> QueryCounts:
        tally = self._tally
        return QueryCounts(
            received=tally.count("received"),
            localised=tally.count("localised"),
            not_localised=tally.by_code("not_localised"),
            errors=tally.by_code("error"),
        )

    # Zenoh calls these in threads of its own; they must return at once.

    def _on_localise(self, query: zenoh.Query) -> None:
        self._tally.add("received")
        client = client_of(str(query.key_expr))
        item = PendingQuery(
            query,
            self._keys.localise(client, self.server_id if is_addressed(str(query.key_expr)) else ""),
            self._options.deadline_s,
            self._tally,
            identity=client if self._authenticates else None,
        )
        try:
            if item.size > self._options.limits.max_bytes:
                raise RequestError(
                    ErrorCode.TOO_LARGE,
                    f"payload: expected at most {self._options.limits.max_bytes} bytes, found {item.size}; "
                    "send a smaller or more compressed picture",
                )
            self._queue.put(item)
            item.watch()
        except RequestError as error:
            item.refuse(error)

    def _say(self, leaf: str, message: Callable[[], BaseModel], query: zenoh.Query) -> None:
        with query:
            query.reply(self._keys.of(leaf), encode(message()), encoding=JSON)

    def _maps(self) -> MapsReply:
        area = self._area
        return MapsReply(database=self.database, snapshot=area.snapshot, maps=area.maps)

    def _watch(self) -> None:
        """Poll the source; a load that fails leaves everything as it is and is tried again."""
        version = served = self._area.snapshot
        wait_s = self._options.poll_interval_s
        while not self._watched.wait(wait_s):
            try:
                version = self._source.version()
                if version != served:
                    area = self._source.load()
                    if not self._watched.is_set():
                        self._swap(area)
                        served = area.snapshot
                wait_s = self._options.poll_interval_s
            except Exception as error:
                # A store may break in many ways; the area in service is whole and stays.
                told = fields("reload_failed", snapshot=version)
                logger.exception("reload failed; the running snapshot stays in service", extra=told)
                self._reload_error = f"snapshot {version}: {type(error).__name__}: {error}"
                self._publish("reload_failed", detail=self._reload_error)
                wait_s = min(2 * wait_s, _MAX_RETRY_S)

    def _swap(self, area: ServedArea) -> None:
        """Serve `area` from now on; queries in hand keep the old one until they are answered."""
        self._workers.publish(area)
        old, self._area = self._area, area
        self._reloads += 1
        self._reload_error = None
        self._log("reloaded", snapshot=area.snapshot, previous=old.snapshot, maps=len(area.maps))
        self._advertise(area)
        before, after = ({info.map_id: info for info in a.maps} for a in (old, area))
        for map_id, info in after.items():
            if map_id not in before or before[map_id].content_digest != info.content_digest:
                self._publish("map_committed", map_id=map_id, detail=info.name)
        for map_id in before.keys() - after.keys():
            self._publish("map_retired", map_id=map_id, detail=before[map_id].name)
        self._publish("reloaded", detail=f"from snapshot {old.snapshot}")

    def _advertise(self, area: ServedArea) -> None:
        """Liveliness tokens of the server and of each tile it answers for."""
        wanted = {self._keys.server_token(self.server_id)}
        wanted |= {self._keys.tile_token(self.server_id, tile) for tile in area.tiles}
        with self._token_lock:
            if self._closed:
                return
            for key in wanted - self._tokens.keys():
                self._tokens[key] = self._session.liveliness().declare_token(key)
            for key in self._tokens.keys() - wanted:
                self._tokens.pop(key).undeclare()

    def _publish(self, kind: EventType, *, map_id: str | None = None, detail: str = "") -> None:
        event = Event(
            type=kind,
            database=self.database,
            server_id=self.server_id,
            snapshot=self._area.snapshot,
            map_id=map_id,
            detail=detail,
            time=datetime.now(UTC).isoformat(),
        )
        publish(self._session, self._keys.of("events"), event, zenoh.CongestionControl.BLOCK)

    def _log(self, event: str, **values: object) -> None:
        logger.info("%s %s", self.database, event, extra=fields(event, database=self.database, **values))
