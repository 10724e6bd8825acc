"""Ask a relocalisation server over Zenoh. Needs nothing but eclipse-zenoh and the image's bytes."""

import random
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Self, TypeVar

import zenoh
from pydantic import BaseModel, ValidationError

from featuredb.errors import InvalidValueError, ServiceError
from reloc.client.connection import (
    NO_SERVER,
    TIMEOUT,
    client_config,
    first_reply,
    name_in,
    read_message,
    wait_for_database,
)
from reloc.client.fleet import ANY, WHOLE, Fleet, best_supported
from reloc.client.live import LiveTrack
from reloc.configuration import read_configuration
from reloc.wire.keys import ANONYMOUS, DEFAULT_ENDPOINT, Keys
from reloc.wire.query import (
    CameraRequest,
    ErrorCode,
    LocaliseReply,
    LocaliseWireRequest,
    PriorRequest,
    RequestOptions,
    encode,
    explain,
)
from reloc.wire.server import MapsReply, StatusReply

_Message = TypeVar("_Message", bound=BaseModel)

_TIMEOUT_S = 10.0  # Zenoh's own default
# The server's deadline is this much earlier than the client's timeout, so that its word arrives in time.
_DEADLINE_MARGIN_S = 0.2
_FIRST_WAIT_S = 0.25  # before a busy server is asked again, as long as a query takes; then twice that
_LEAST_S = 0.002  # of which the server is told half; messages take no less than a millisecond
_LEAST_LEFT_S = 0.1  # with less, a busy server is not asked again
_STATUS_S = 1.0  # for all servers to say who they are


class Client:
    """Connection to a relocalisation server; a context manager.

    `database=None` takes the only database that is served at the endpoint. `config_path`: a Zenoh
    configuration instead of `connect`, such as `featuredb keys client` writes.

        with Client("tcp/127.0.0.1:7447") as client:
            reply = client.localise("photo.jpg")
            if reply.utm is not None:
                print(reply.utm.easting, reply.utm.northing, reply.accuracy)
            else:
                print(reply.reason, reply.detail)

    Methods raise ServiceError; its `code` is one of reloc.wire.query.ErrorCode, or NO_SERVER (nobody
    answers), TIMEOUT (no answer in time), BAD_REPLY (an answer that is none).
    """

    def __init__(
        self,
        connect: str = DEFAULT_ENDPOINT,
        database: str | None = None,
        *,
        config_path: Path | None = None,
        connect_timeout_s: float = 5.0,
    ) -> None:
        self._connect = connect
        self._asked_for = self._database = database
        self._config_path = config_path
        self._connect_timeout_s = connect_timeout_s
        self._open_session: zenoh.Session | None = None
        self._fleet = Fleet(self.statuses)
        self.name = ANONYMOUS  # on the wire; its configuration says it

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *failed: object) -> None:
        self.close()

    def open(self) -> None:
        """Connect and wait until a server of the database is there; the second call looks for one again.

        Raises:
            ServiceError: NO_SERVER, nobody at the endpoint, or no (or not exactly one) database.
            InvalidValueError: the configuration cannot be read.
        """
        session = self._open_session or self._connected()
        try:
            self._database = wait_for_database(session, self._asked_for, self._where, self._connect_timeout_s)
        except ServiceError:
            if session is not self._open_session:
                session.close()
            raise
        self._open_session = session

    def _connected(self) -> zenoh.Session:
        config = None
        if self._config_path is not None:
            config = read_configuration(self._config_path)
            self.name = name_in(config)
        try:
            return zenoh.open(config or client_config(self._connect, self._connect_timeout_s))
        except zenoh.ZError as error:
            asked = "is `featuredb serve` running, and is this its --listen endpoint?"
            raise ServiceError(NO_SERVER, f"nobody answers at {self._where}; {asked}") from error

    def close(self) -> None:
        """Disconnect; the second call does nothing."""
        if self._open_session is not None:
            self._open_session.close()
            self._open_session = None

    @property
    def database(self) -> str:
        """Name of the database on the wire."""
        self._session()
        return str(self._database)

    def localise(
        self,
        image: bytes | str | Path,
        prior: PriorRequest | None = None,
        camera: CameraRequest | None = None,
        *,
        timeout_s: float = _TIMEOUT_S,
        request_id: str | None = None,
        inliers: bool = False,
        exif_prior: bool = False,
        maps: tuple[str, ...] | None = None,
        contribute: bool = False,
        credit: str | None = None,
        licence: str | None = None,
        client_id: str | None = None,
    ) -> LocaliseReply:
        """Where was this photo taken?

        Args:
            image: the image file's bytes, or its path.
            prior: where it may have been taken (degrees, metres).
            camera: intrinsics; without them EXIF, the maps' cameras or an estimate serve.
            timeout_s: the longest wait; the server is told, and gives up in time. A server that is busy is
                asked again, ever less often, while it lasts.
            request_id: appears in the reply and in the server's log.
            inliers: the reply carries pixels and UTM points of the matches that agree.
            exif_prior: the position in the photo's EXIF settles what is ambiguous, where `prior` is None.
            maps: ask only these maps.
            contribute: give the photo to the database, so that its maps can grow; needs `credit` and
                `licence`. The reply's `contribution` says whether it was taken.
            credit: whom to name with it. licence: the terms under which it is given, such as CC-BY-4.0.
            client_id: what this client calls itself, kept with the photo.

        Raises:
            ServiceError: see the class.
            InvalidValueError: arguments that no server takes.
        """
        try:
            request = LocaliseWireRequest(
                request_id=request_id,
                prior=prior,
                camera=camera,
                contribute=contribute,
                credit=credit,
                licence=licence,
                client_id=client_id,
                options=RequestOptions(
                    inliers=inliers, exif_prior=exif_prior, maps=maps, deadline_ms=_deadline_ms(timeout_s)
                ),
            )
        except ValidationError as error:
            raise InvalidValueError(f"localise: {explain(error)}") from error
        data = image if isinstance(image, bytes) else Path(image).read_bytes()
        return self.ask(data, request, timeout_s)

    def ask(self, data: bytes, request: LocaliseWireRequest, timeout_s: float) -> LocaliseReply:
        """`localise` of an image file's bytes, with its other arguments in one; they say no deadline.

        Raises:
            ServiceError: see the class.
        """
        end = time.perf_counter() + timeout_s
        prior = None if request.options.maps else request.prior  # maps are named wherever they lie
        first, *others = self._fleet.parts(prior, _status_s(timeout_s))
        if not others:
            return self._ask_part(first, data, request, end)
        # It is given once.
        again = request.model_copy(update={"contribute": False, "credit": None, "licence": None})
        with ThreadPoolExecutor(1 + len(others)) as pool:
            asked = [pool.submit(self._ask_part, first, data, request, end)]
            asked += [pool.submit(self._ask_part, part, data, again, end) for part in others]
        replies = [one.result() for one in asked if one.exception() is None]
        for error in (one.exception() for one in asked):
            # Maps that are another server's are none of this one. What a silent part shows, nobody knows.
            refused = isinstance(error, ServiceError) and error.code == ErrorCode.BAD_REQUEST
            if error is not None and not (replies and refused and "options.maps" in str(error)):
                raise error
        given = asked[0].result().contribution if asked[0].exception() is None else None
        return best_supported(replies).model_copy(update={"contribution": given})

    def _ask_part(self, part: str, data: bytes, request: LocaliseWireRequest, end: float) -> LocaliseReply:
        """The answer of one of the servers of a part; where one is lost or busy, of another."""
        wait_s, said = _FIRST_WAIT_S, None
        lost: set[str] = set()
        while True:
            refusal: ServiceError | None = None
            left_s = end - time.perf_counter()
            servers = [s for s in self._fleet.servers(part, _status_s(left_s)) if s not in lost]
            if not servers and part != WHOLE:
                gone = f"no server of the part {part} of database {self._database!r} answers at {self._where}"
                raise said or ServiceError(NO_SERVER, gone)
            for server_id in servers or [ANY]:
                left_s = end - time.perf_counter()
                if left_s < _LEAST_S:
                    raise refusal or ServiceError(TIMEOUT, "no server answered in time")
                options = request.options.model_copy(update={"deadline_ms": _deadline_ms(left_s)})
                asked = encode(request.model_copy(update={"options": options}))
                key = self._keys.localise(self.name, server_id)
                try:
                    return self._ask(key, LocaliseReply, left_s, payload=data, attachment=asked)
                except ServiceError as error:
                    if error.code == TIMEOUT:
                        self._fleet.lose(server_id)
                        raise said or error from None  # a server that ends may be silent when asked again
                    if error.code in (NO_SERVER, ErrorCode.SHUTTING_DOWN) and server_id != ANY:
                        self._fleet.lose(server_id)
                        lost.add(server_id)
                        said = error
                    elif error.code != ErrorCode.BUSY:
                        raise said if said is not None and error.code == NO_SERVER else error from None
                    refusal = error
            assert refusal is not None
            # So that those who were refused do not return at once; who lost all servers looks for others.
            pause_s = wait_s * random.uniform(0.5, 1.5) if refusal.code == ErrorCode.BUSY else 0.0
            if time.perf_counter() + pause_s + _LEAST_LEFT_S >= end:
                raise refusal
            time.sleep(pause_s)
            wait_s *= 2

    def status(self, timeout_s: float = _TIMEOUT_S) -> StatusReply:
        """Counts, latencies, snapshot and limits of the server."""
        return self._ask(self._keys.of("status"), StatusReply, timeout_s)

    def statuses(self, timeout_s: float = _STATUS_S) -> list[StatusReply]:
        """`status` of each server of the database that answers within the time."""
        found = self._ask_all(self._keys.of("status"), StatusReply, timeout_s)
        return list({status.server_id: status for status in found}.values())

    def maps(self, timeout_s: float = _TIMEOUT_S) -> MapsReply:
        """The maps that the server answers from; those of all parts where servers have parts."""
        if self._fleet.parts(None, _status_s(timeout_s)) == [WHOLE]:
            return self._ask(self._keys.of("maps"), MapsReply, timeout_s)
        found = self._ask_all(self._keys.of("maps"), MapsReply, timeout_s)
        if not found:
            raise ServiceError(NO_SERVER, f"no server of database {self._database!r} answers any more")
        maps = {info.map_id: info for reply in found for info in reply.maps}
        newest = max(found, key=lambda reply: reply.snapshot)
        return newest.model_copy(update={"maps": tuple(maps.values())})

    def _ask_all(self, key: str, model: type[_Message], timeout_s: float) -> list[_Message]:
        """What all servers that answer within the time say."""
        replies = self._session().get(
            key,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout_s,
            source_info=zenoh.SourceInfo(self._session().id, 0),
        )
        found = []
        for payload in (reply.ok.payload for reply in replies if reply.ok is not None):
            with suppress(ServiceError):  # what is no such message is nobody's
                found.append(read_message(payload.to_bytes(), model))
        return found

    def track(
        self,
        camera: CameraRequest | None = None,  # of the frames, in any size; None: estimated
        prior: PriorRequest | None = None,  # where the first frame may have been taken
        *,
        timeout_s: float = _TIMEOUT_S,  # the longest wait for the session to open
    ) -> LiveTrack:
        """A live session, to be used in a `with` block: frames are sent, and poses come.

        with client.track() as live:
            for jpeg, time_s in frames:
                live.send(jpeg, time_s)
                pose = live.next(timeout_s=0.1)
        """
        return LiveTrack(self._session(), self._keys, self.name, camera, prior, timeout_s)

    def _session(self) -> zenoh.Session:
        if self._open_session is None:
            raise ServiceError(
                NO_SERVER, "the client is not connected; use it in a `with` block or call open()"
            )
        return self._open_session

    @property
    def _where(self) -> str:
        return str(self._config_path or self._connect)

    @property
    def _keys(self) -> Keys:
        return Keys(database=str(self._database))

    def _ask(self, key: str, model: type[_Message], timeout_s: float, **sent: bytes) -> _Message:
        start = time.perf_counter()
        found = first_reply(
            self._session(),
            key,
            model,
            timeout_s,
            **sent,
            # A photo is many fragments; dropping one of them under load would lose the query silently.
            congestion_control=zenoh.CongestionControl.BLOCK,
            express=True,
        )
        if found is not None:
            return found
        waited_s = time.perf_counter() - start
        if waited_s >= 0.9 * timeout_s:
            raise ServiceError(TIMEOUT, f"no answer within {timeout_s:g} s from {key}")
        raise ServiceError(
            NO_SERVER, f"no server of database {self._database!r} answers any more at {self._where}"
        )


def _status_s(left_s: float) -> float:
    """How long servers may take to say who they are, of the time that is left for an answer."""
    return min(_STATUS_S, max(0.3 * left_s, _LEAST_S))


def _deadline_ms(left_s: float) -> float:
    """What the server is told of the time that is left."""
    return 1e3 * max(left_s - _DEADLINE_MARGIN_S, 0.5 * left_s)
