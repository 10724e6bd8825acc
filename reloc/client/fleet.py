"""The servers of one database: which there are, whom to ask, and one answer out of several.

Servers that answer from the same part of the database stand in for each other. A prior says which parts a
photo can show; without one all are asked, and the best-supported answer counts.
"""

import math
import threading
import time
from collections.abc import Callable, Sequence

from reloc.wire.query import LocaliseReply, Position, PriorRequest
from reloc.wire.server import BoundingBox, StatusReply

ANY = ""  # instead of a server's id: whichever Zenoh finds
_FRESH_S = 10.0  # so long the list of servers is believed
_SIGMAS, _REACH_M = 3.0, 1000.0  # of a prior, and of what a camera there may see, for a part's bounds
_RIVAL_SHARE = 0.6  # as `reloc.localise.acceptance` has it: of the winner's inliers, for a place elsewhere
_DEGREE_M = 111_000.0


class Fleet:
    """Who answers, as the servers say it themselves; for several threads."""

    def __init__(self, ask_all: Callable[[], Sequence[StatusReply]]) -> None:
        """`ask_all`: status of each server that answers now."""
        self._ask_all = ask_all
        self._lock = threading.Lock()
        self._parts: dict[str, list[StatusReply]] = {}
        self._until = 0.0
        self._turn = 0

    def parts(self, prior: PriorRequest | None) -> list[str]:
        """Names of the parts that may show what a camera within the prior sees; all without one.

        Where the prior touches none, one of them, which says so; where nobody answers, "".
        """
        with self._lock:
            parts = self._fresh()
            if prior is not None:
                near = [name for name, servers in parts.items() if _touches(servers[0].bounds, prior)]
                return near or list(parts)[:1] or [""]
            return list(parts) or [""]

    def servers(self, part: str) -> list[str]:
        """Ids of the servers of a part, another one first each time; ANY where none can be addressed."""
        with self._lock:
            servers = self._fresh().get(part, [])
            ids = [server.server_id if server.addressable else ANY for server in servers] or [ANY]
            self._turn += 1
            first = self._turn % len(ids)
            return [*ids[first:], *ids[:first]]

    def lose(self, server_id: str) -> None:
        """It does not answer; the list is made anew where that leaves a part without a server."""
        with self._lock:
            for part, servers in list(self._parts.items()):
                self._parts[part] = [server for server in servers if server.server_id != server_id]
                if not self._parts[part]:
                    self._until = 0.0

    def _fresh(self) -> dict[str, list[StatusReply]]:
        if time.monotonic() >= self._until:
            parts: dict[str, list[StatusReply]] = {}
            for status in sorted(self._ask_all(), key=lambda status: status.server_id):
                parts.setdefault(status.part, []).append(status)
            # Whoever answers from all of it makes the parts needless.
            self._parts = {"": parts[""]} if "" in parts else parts
            self._until = time.monotonic() + _FRESH_S
        return self._parts


def _touches(bounds: BoundingBox | None, prior: PriorRequest) -> bool:
    if bounds is None:
        return False
    reach = (_SIGMAS * prior.sigma_m + _REACH_M) / _DEGREE_M
    across = reach / max(math.cos(math.radians(prior.lat)), 1e-3)
    east_of_west = (prior.lon - bounds.west + across) % 360.0
    between = bounds.south - reach <= prior.lat <= bounds.north + reach
    return between and bool(east_of_west <= bounds.east - bounds.west + 2.0 * across)


def best_supported(replies: Sequence[LocaliseReply]) -> LocaliseReply:
    """The answer with most inliers; AMBIGUOUS where another place has about as many.

    Args:
        replies: one of each part, at least one.
    """
    ranked = sorted(replies, key=lambda reply: (reply.inliers, reply.matches), reverse=True)
    found = [reply for reply in ranked if reply.status != "not_localised"]
    if not found:
        return ranked[0]
    best = found[0]
    for other in ranked:
        if other is best or other.inliers < _RIVAL_SHARE * best.inliers:
            continue
        if other.reason == "AMBIGUOUS" or _is_elsewhere(best, other):
            return _ambiguous(best, other)
    return best


def _is_elsewhere(one: LocaliseReply, other: LocaliseReply) -> bool:
    if one.position is None or other.position is None or one.accuracy is None or other.accuracy is None:
        return False
    apart = _distance_m(one.position, other.position)
    return apart > 3.0 * (one.accuracy.horizontal_68_m + other.accuracy.horizontal_68_m) + 1.0


def _distance_m(one: Position, other: Position) -> float:
    north = (other.lat - one.lat) * _DEGREE_M
    turn = (other.lon - one.lon + 180.0) % 360.0 - 180.0
    return math.hypot(north, turn * _DEGREE_M * math.cos(math.radians(one.lat)))


def _ambiguous(best: LocaliseReply, rival: LocaliseReply) -> LocaliseReply:
    pose = ("position", "quaternion", "utm", "covariance", "accuracy", "camera", "height_datum", "in_map")
    gone = dict.fromkeys((*pose, "view_covariance", "residual_rms_px", "inlier_points", "runner_up"))
    said = {
        "status": "not_localised",
        "reason": "AMBIGUOUS",
        "detail": f"another server's pose elsewhere has {rival.inliers} inliers, this one {best.inliers}",
        "confidence": 0.0,
        "maps": (),
        "lineage": (),
    }
    return LocaliseReply.model_validate({**dict(best), **gone, **said})
