"""The servers of one database: which there are, whom to ask, and one answer out of several.

Servers that answer from the same part of the database stand in for each other. A prior says which parts a
photo can show; without one all are asked, and the best-supported answer counts.
"""

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from reloc.wire.query import LocaliseReply, PriorRequest
from reloc.wire.server import BoundingBox, StatusReply

ANY = ""  # instead of a server's id: whichever has the whole database
WHOLE = ""  # the part that is all
_FRESH_S = 10.0  # so long the list of servers is believed
_MISSED_S = 60.0  # so long a part whose last server is gone is missed, and not taken for gone
_SIGMAS, _REACH_M = 3.0, 2000.0  # of a prior, and of what a camera there may see, for a part's bounds
_RIVAL_SHARE = 0.6  # as `reloc.localise.acceptance` has it: of the winner's inliers, for a place elsewhere
_DEGREE_M = 111_000.0
_SAME_M, _SAME_DEG = 1.0, 5.0  # poses this near, beside three times their radii, are of one place


@dataclass(frozen=True, slots=True, kw_only=True)
class _Part:
    servers: tuple[StatusReply, ...]
    seen: float  # when a server of it answered last

    @property
    def bounds(self) -> list[BoundingBox]:
        return [server.bounds for server in self.servers if server.bounds is not None]


@dataclass(slots=True, kw_only=True)
class _State:
    """What is known; replaced as a whole."""

    parts: dict[str, _Part] = field(default_factory=dict)
    lost: set[str] = field(default_factory=set)
    until: float = 0.0


class Fleet:
    """Who answers, as the servers say it themselves; for several threads."""

    def __init__(self, ask_all: Callable[[float], Sequence[StatusReply]]) -> None:
        """`ask_all`: status of each server that answers within so many seconds."""
        self._ask_all = ask_all
        self._state = _State()
        self._asking = threading.Lock()  # one thread makes the list anew; the others use the old one
        self._turns: dict[str, int] = {}

    def parts(self, prior: PriorRequest | None, timeout_s: float) -> list[str]:
        """Names of the parts that may show what a camera within the prior sees; all without one.

        Where the prior touches none, one of them, which says so; where nobody answers, WHOLE.
        """
        parts = self._fresh(timeout_s).parts
        if prior is None or WHOLE in parts:
            return list(parts) or [WHOLE]
        near = [name for name, part in parts.items() if any(_touches(box, prior) for box in part.bounds)]
        answering = [name for name, part in parts.items() if self._ids(part)]
        return near or answering[:1] or list(parts)[:1] or [WHOLE]

    def servers(self, part: str, timeout_s: float) -> list[str]:
        """Ids of the servers of a part, another one first each time; none where they are lost."""
        ids = self._ids(self._fresh(timeout_s).parts.get(part))
        if not ids:  # another thread may be about to learn of others
            ids = self._ids(self._fresh(timeout_s, wait=True).parts.get(part))
        if not ids:
            return []
        turn = self._turns[part] = self._turns.get(part, 0) + 1
        first = turn % len(ids)
        return [*ids[first:], *ids[:first]]

    def lose(self, server_id: str) -> None:
        """It does not answer; the list is made anew where that leaves a part without a server."""
        state = self._state
        state.lost.add(server_id)
        if any(part.servers and not self._ids(part) for part in state.parts.values()):
            state.until = 0.0

    def _ids(self, part: _Part | None) -> list[str]:
        if part is None:
            return []
        lost = self._state.lost
        return [s.server_id if s.addressable else ANY for s in part.servers if s.server_id not in lost]

    def _fresh(self, timeout_s: float, *, wait: bool = False) -> _State:
        """What is known now; `wait`: until another thread that asks has learnt it."""
        state = self._state
        if time.monotonic() < state.until and not wait:
            return state
        if not self._asking.acquire(blocking=wait or not state.parts):
            return state
        try:
            if self._state is state and time.monotonic() >= state.until:
                self._state = _next(state, self._ask_all(timeout_s))
            return self._state
        finally:
            self._asking.release()


def _next(state: _State, answered: Sequence[StatusReply]) -> _State:
    now = time.monotonic()
    by_part: dict[str, list[StatusReply]] = {}
    for status in sorted(answered, key=lambda status: status.server_id):
        by_part.setdefault(status.part, []).append(status)
    parts = {name: _Part(servers=tuple(servers), seen=now) for name, servers in by_part.items()}
    if WHOLE in parts:  # whoever answers from all of it makes the parts needless
        return _State(parts={WHOLE: parts[WHOLE]}, until=now + _FRESH_S)
    held = [box for part in parts.values() for box in part.bounds]
    missed = {
        name: part
        for name, part in state.parts.items()
        if name not in parts
        and name != WHOLE
        and now - part.seen < _MISSED_S
        and not all(any(_within(box, other) for other in held) for box in part.bounds)
    }
    lost = {server.server_id for part in missed.values() for server in part.servers}
    return _State(parts=missed | parts, lost=lost, until=now + _FRESH_S)


def _within(box: BoundingBox, other: BoundingBox) -> bool:
    return (
        other.west <= box.west
        and box.east <= other.east
        and other.south <= box.south
        and box.north <= other.north
    )


def _touches(bounds: BoundingBox, prior: PriorRequest) -> bool:
    reach = (_SIGMAS * prior.sigma_m + _REACH_M) / _DEGREE_M
    across = reach / max(math.cos(math.radians(prior.lat)), 1e-3)
    east_of_west = (prior.lon - bounds.west + across) % 360.0
    between = bounds.south - reach <= prior.lat <= bounds.north + reach
    return between and bool(east_of_west <= bounds.east - bounds.west + 2.0 * across)


def best_supported(replies: Sequence[LocaliseReply]) -> LocaliseReply:
    """The answer with most inliers; AMBIGUOUS where another reply has about as many and not the same pose.

    `replies`: one of each part, at least one. What another server refused counts, too, as it would within
    one: only its inliers are known, so that it is taken for another place.
    """
    ranked = sorted(replies, key=lambda reply: (reply.inliers, reply.matches), reverse=True)
    found = [reply for reply in ranked if reply.status != "not_localised"]
    if not found:
        return ranked[0]
    best = found[0]
    for other in ranked:
        strong = other.inliers >= _RIVAL_SHARE * best.inliers
        # What the photo's own position decided between had about as many.
        decided = other.exif_prior is not None and other.exif_prior.role == "decided"
        if other is not best and (strong or decided) and not _is_same(best, other):
            return _ambiguous(best, other)
    return best


def _is_same(one: LocaliseReply, other: LocaliseReply) -> bool:
    """Whether two replies have one pose, as well as they know it."""
    if one.position is None or other.position is None or one.quaternion is None or other.quaternion is None:
        return False
    assert one.accuracy is not None
    assert other.accuracy is not None
    both = (one.accuracy, other.accuracy)
    north = (other.position.lat - one.position.lat) * _DEGREE_M
    turn = (other.position.lon - one.position.lon + 180.0) % 360.0 - 180.0
    east = turn * _DEGREE_M * math.cos(math.radians(one.position.lat))
    up = other.position.h - one.position.h if one.height_datum == other.height_datum else 0.0
    q, p = one.quaternion, other.quaternion
    dot = abs(q.x * p.x + q.y * p.y + q.z * p.z + q.w * p.w)
    angle_deg = math.degrees(2.0 * math.acos(min(1.0, dot)))
    return (
        math.hypot(north, east) <= _SAME_M + 3.0 * sum(a.horizontal_68_m for a in both)
        and abs(up) <= _SAME_M + 3.0 * sum(a.vertical_68_m for a in both)
        and angle_deg <= _SAME_DEG + 3.0 * sum(a.orientation_68_deg for a in both)
    )


def _ambiguous(best: LocaliseReply, rival: LocaliseReply) -> LocaliseReply:
    pose = ("position", "quaternion", "utm", "covariance", "accuracy", "camera", "height_datum", "in_map")
    more = ("view_covariance", "residual_rms_px", "inlier_points", "runner_up", "exif_prior")
    gone = dict.fromkeys((*pose, *more))
    said = {
        "status": "not_localised",
        "reason": "AMBIGUOUS",
        "detail": f"another server's pose elsewhere has {rival.inliers} inliers, this one {best.inliers}",
        "confidence": 0.0,
        "maps": (),
        "lineage": (),
    }
    return LocaliseReply.model_validate({**dict(best), **gone, **said})
