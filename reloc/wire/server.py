"""What a server says about itself on the wire: status, maps and events. See `reloc.wire.query`."""

from typing import Literal

from reloc.wire.query import Answer, Count, NotNegative
from reloc.wire.track import LiveStatus


class QueueStatus(Answer):
    """`ready`: workers whose process is up and not beyond its query's deadline; null from older servers."""

    length: Count
    capacity: Count
    workers: Count
    busy: Count
    ready: Count | None = None


class Latency(Answer):
    """Milliseconds from receipt to reply over the latest answered queries; null before the first."""

    count: Count
    p50: NotNegative | None
    p90: NotNegative | None
    p99: NotNegative | None
    max: NotNegative | None


class QueryCounts(Answer):
    received: Count
    localised: Count
    not_localised: dict[str, Count]
    errors: dict[str, Count]


class ReloadStatus(Answer):
    """Hot reloads since the start; `error` is the latest failure while it lasts."""

    count: Count
    error: str | None


class Limits(Answer):
    max_payload_bytes: Count
    max_pixels: Count
    deadline_s: NotNegative


class ContributionStatus(Answer):
    """Contributed photos since the start; `error` is the latest failure of the inbox while it lasts."""

    accepted: Count
    refused: dict[str, Count]
    waiting: Count
    written: Count
    lost: Count
    error: str | None


class BoundingBox(Answer):
    """WGS84 degrees."""

    west: float
    south: float
    east: float
    north: float


class StatusReply(Answer):
    """Answer of `.../status`."""

    database: str
    server_id: str
    version: str
    wire_version: str
    snapshot: Count
    maps: Count
    uptime_s: NotNegative
    queue: QueueStatus
    queries: QueryCounts
    latency_ms: Latency
    reload: ReloadStatus
    limits: Limits
    contributions: ContributionStatus | None = None
    live: LiveStatus | None = None
    # Which part of the database it answers from, as `serve --bbox` has it; "" all of it. Servers of one part
    # can stand in for each other.
    part: str = ""
    bounds: BoundingBox | None = None  # around the maps that it answers from, null without any
    addressable: bool = False  # it can be asked by `localise/<client>/<server id>`


class MapInfo(Answer):
    """One map that the server answers from."""

    map_id: str
    content_digest: str
    name: str
    epsg: int
    height_datum: str
    method: str
    generation: Count
    images: Count
    points: Count
    bounds: BoundingBox | None
    tiles: tuple[str, ...]


class MapsReply(Answer):
    """Answer of `.../maps`."""

    database: str
    snapshot: Count
    maps: tuple[MapInfo, ...]


EventType = Literal["map_committed", "map_retired", "reloaded", "reload_failed", "stopping"]


class Event(Answer):
    """Publication on `.../events`."""

    type: EventType
    database: str
    server_id: str
    snapshot: Count
    map_id: str | None
    detail: str
    time: str
