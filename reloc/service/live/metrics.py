"""Counts and latencies of a server's live sessions."""

import threading
from collections import Counter, deque
from dataclasses import dataclass, field

import numpy as np

from reloc.wire.track import LiveFrameCounts, LiveLatency, LiveStatus

_LATENCY_WINDOW = 1000  # latest frames: half a minute of one session


@dataclass(slots=True)
class LiveMetrics:
    """Counters that threads share; every method takes the lock."""

    _lock: threading.Lock = field(default_factory=threading.Lock)
    _opened: int = 0
    _refused: Counter[str] = field(default_factory=Counter)
    _ended: Counter[str] = field(default_factory=Counter)
    _received: int = 0
    _dropped: int = 0
    _answered: Counter[str] = field(default_factory=Counter)
    _refused_frames: Counter[str] = field(default_factory=Counter)
    _latency_ms: deque[float] = field(default_factory=lambda: deque(maxlen=_LATENCY_WINDOW))

    def opened(self) -> None:
        with self._lock:
            self._opened += 1

    def open_refused(self, code: str) -> None:
        with self._lock:
            self._refused[code] += 1

    def ended(self, reason: str) -> None:
        with self._lock:
            self._ended[reason] += 1

    def frame_received(self, *, dropped: bool) -> None:
        """A frame came; `dropped`: it, or the one that waited in its place, will not be looked at."""
        with self._lock:
            self._received += 1
            self._dropped += dropped

    def frame_answered(self, state: str, latency_ms: float) -> None:
        with self._lock:
            self._answered[state] += 1
            self._latency_ms.append(latency_ms)

    def frame_refused(self, code: str) -> None:
        with self._lock:
            self._refused_frames[code] += 1

    def status(self, *, open_now: int, capacity: int) -> LiveStatus:
        with self._lock:
            values = np.array(self._latency_ms)
            latency = LiveLatency(count=0, p50=None, p95=None, max=None)
            if len(values):
                p50, p95 = (round(float(v), 3) for v in np.percentile(values, [50, 95]))
                latency = LiveLatency(count=len(values), p50=p50, p95=p95, max=round(float(values.max()), 3))
            return LiveStatus(
                open=open_now,
                capacity=capacity,
                opened=self._opened,
                refused=dict(sorted(self._refused.items())),
                ended=dict(sorted(self._ended.items())),
                frames=LiveFrameCounts(
                    received=self._received,
                    answered=dict(sorted(self._answered.items())),
                    refused=dict(sorted(self._refused_frames.items())),
                    dropped=self._dropped,
                ),
                latency_ms=latency,
            )
