"""What a server says of itself, as Prometheus has it: on its own page, and on a gateway's."""

from collections.abc import Callable, Iterator, Mapping

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from reloc.wire.server import StatusReply

_NAME = "featuredb_server_"


class Figures(Collector):
    """What a function says whenever the page is asked for."""

    def __init__(self, ask: Callable[[], Iterator[Metric]]) -> None:
        self._ask = ask

    def collect(self) -> Iterator[Metric]:
        return self._ask()


def status_metrics(status: StatusReply | None) -> Iterator[Metric]:
    """The figures of a server; of one that does not answer (None) that alone."""
    yield _gauge("up", "1 if a server answers.", int(status is not None))
    if status is None:
        return
    queue, queries = status.queue, status.queries
    outcomes = {("localised", ""): queries.localised}
    outcomes |= {("not_localised", reason): count for reason, count in queries.not_localised.items()}
    outcomes |= {("error", code): count for code, count in queries.errors.items()}
    yield _outcomes("queries", "Queries by what became of them.", outcomes)
    latency = GaugeMetricFamily(
        f"{_NAME}query_seconds", "From receipt to reply, of the latest 1000.", labels=["quantile"]
    )
    for quantile, ms in (("0.5", status.latency_ms.p50), ("0.99", status.latency_ms.p99)):
        if ms is not None:
            latency.add_metric([quantile], ms / 1e3)
    yield latency
    yield _gauge("queue_length", "Queries that wait.", queue.length)
    yield _gauge("queue_capacity", "Queries that may wait.", queue.capacity)
    yield _gauge("workers_busy", "Queries in work.", queue.busy)
    if queue.ready is not None:
        yield _gauge("workers_ready", "Workers that can take a query, or have one in time.", queue.ready)
    yield _gauge("maps", "Maps that answer.", status.maps)
    yield _gauge("snapshot", "Version served.", status.snapshot)
    yield _gauge(
        "reload_failed", "1 while a newer version cannot be loaded.", status.reload.error is not None
    )
    yield _gauge("uptime_seconds", "Since its start.", status.uptime_s)
    if status.contributions is not None:
        given = status.contributions
        counts = {("accepted", ""): given.accepted, ("lost", ""): given.lost}
        counts |= {("refused", reason): count for reason, count in given.refused.items()}
        yield _outcomes("contributions", "Contributed photos by what became of them.", counts)
        yield _gauge("contributions_waiting", "Photos that wait to be written.", given.waiting)
        yield _gauge("inbox_failed", "1 while the inbox cannot be written.", given.error is not None)
    if status.live is not None:
        live = status.live
        yield _gauge("live_sessions", "Live sessions that are open.", live.open)
        yield _gauge("live_sessions_capacity", "Live sessions that may be open.", live.capacity)
        frames = {("answered", state): count for state, count in live.frames.answered.items()}
        frames |= {("refused", code): count for code, count in live.frames.refused.items()}
        frames |= {("dropped", ""): live.frames.dropped}
        yield _outcomes("live_frames", "Frames of live sessions by what became of them.", frames)


def _gauge(name: str, told: str, value: float) -> Metric:
    return GaugeMetricFamily(_NAME + name, told, value=float(value))


def _outcomes(name: str, told: str, counts: Mapping[tuple[str, str], int]) -> Metric:
    family = CounterMetricFamily(_NAME + name, told, labels=["outcome", "code"])
    for labels, count in counts.items():
        family.add_metric(labels, count)
    return family
