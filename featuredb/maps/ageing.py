"""Points that photos should have seen and did not: when to stop looking for them.

No photo finds all that it shows: of the visible points it finds a part, some points nearly always and some
hardly ever. So one miss says nothing, and many say only how seldom a point is found. Rates of the map's
points are taken as drawn from a Beta distribution, fitted to the counts of all of them; what is known of one
point is that distribution after its own counts. A point is aged once it is nearly certain that photos find it
less than a third as often as the map's average point: whether its place was rebuilt or it was never any good,
it costs a descriptor, competes in the ratio test, and gives little.

Where photos find a third of what they show, at rates as uneven as Beta(4, 8), that takes about fifty
independent sources without a hit; where they find most, ten.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import frozen_array
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.thin import with_descriptors


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sighting:
    """What one localised photo says about the points of one map.

    Attributes:
        map_id: of the map. write_id: of its state; rows of points mean something in that state only.
        source: who took it, when, with what; photos of one source are not independent of each other.
        expected: (e,) int64, rows of the map's points that the photo should show.
        seen: (s,) int64, those of them that it found.
    """

    map_id: str
    write_id: str
    source: str
    expected: NDArray[np.int64]
    seen: NDArray[np.int64]

    def __post_init__(self) -> None:
        for name in ("expected", "seen"):
            rows = frozen_array(f"Sighting.{name}", getattr(self, name), (None,), np.int64)
            object.__setattr__(self, name, rows)
        if not np.isin(self.seen, self.expected).all():
            raise InvalidValueError(f"Sighting of map {self.map_id}: a point was seen that was not expected")


@dataclass(frozen=True, slots=True, kw_only=True)
class AgeOptions:
    """When a point is given up.

    Attributes:
        useful_share: a point is worth its descriptor if it is found at least this share as often as the
            average one.
        certainty: with which it is not. A mistake costs a point that is seldom found, and a rollback or
            another ingest brings it back.
        least_expected: sources that should have seen it; a season or a parked lorry is one or two.
        least_sources: of all sightings together; fewer tell nothing about how rates spread.
    """

    useful_share: float = 1.0 / 3.0
    certainty: float = 0.95
    least_expected: int = 8
    least_sources: int = 10

    def __post_init__(self) -> None:
        if not (0 < self.useful_share < 1 and 0.5 < self.certainty < 1 and self.least_expected >= 1):
            raise InvalidValueError(f"AgeOptions: value out of range in {self}")


def count_sightings(
    sightings: Iterable[Sighting], points: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """Sources that should have seen each point (n,), those that did (n,), and the number of all sources.

    A source counts once, however many photos it sends; it saw a point if one of its photos did.
    """
    by_source: dict[str, tuple[NDArray[np.bool_], NDArray[np.bool_]]] = {}
    for sighting in sightings:
        if sighting.source not in by_source:
            by_source[sighting.source] = np.zeros(points, np.bool_), np.zeros(points, np.bool_)
        expected, seen = by_source[sighting.source]
        expected[sighting.expected] = True
        seen[sighting.seen] = True
    expected_of, seen_of = np.zeros(points, np.int64), np.zeros(points, np.int64)
    for expected, seen in by_source.values():
        expected_of += expected
        seen_of += seen
    return expected_of, seen_of, len(by_source)


def rate_distribution(expected: NDArray[np.int64], seen: NDArray[np.int64]) -> tuple[float, float]:
    """Parameters (a, b) of the Beta distribution of rates, by moments of all counts.

    The variance of seen is n m (1 - m) (1 + (n - 1) rho) with the mean rate m; rho = 1 / (a + b + 1).
    """
    n, x = expected.astype(np.float64), seen.astype(np.float64)
    mean = float(np.clip(x.sum() / max(n.sum(), 1.0), 1e-3, 1.0 - 1e-3))
    even = n * mean * (1.0 - mean)
    excess = float(((x - n * mean) ** 2 - even).sum())
    # Nearly equal rates would leave the distribution without width, and one miss would count for nothing.
    rho = float(np.clip(excess / max(float((even * (n - 1.0)).sum()), 1e-9), 0.02, 0.9))
    size = 1.0 / rho - 1.0
    return mean * size, (1.0 - mean) * size


def aged_points(
    expected: NDArray[np.int64], seen: NDArray[np.int64], options: AgeOptions | None = None
) -> NDArray[np.bool_]:
    """Points (n,) that photos find too seldom to be worth their descriptors.

    Args:
        expected, seen: (n,) counts over independent sources, as `count_sightings` gives them.

    Raises:
        InvalidValueError: a point was seen more often than expected.
    """
    options = options or AgeOptions()
    if (seen > expected).any() or (seen < 0).any():
        raise InvalidValueError("aged_points: expected 0 <= seen <= expected at every point")
    a, b = rate_distribution(expected, seen)
    limit = options.useful_share * a / (a + b)
    below = betainc(a + seen, b + (expected - seen), limit)
    return np.asarray((expected >= options.least_expected) & (below >= options.certainty), dtype=np.bool_)


def age_map(
    feature_map: FeatureMap, sightings: Iterable[Sighting], options: AgeOptions | None = None
) -> FeatureMap:
    """The map without descriptors at aged points; as it is where there are none, or too few sources.

    Sightings of other maps, and of other states of this one, must have been left out.
    """
    options = options or AgeOptions()
    expected, seen, sources = count_sightings(sightings, len(feature_map.points))
    if sources < options.least_sources:
        return feature_map
    aged = aged_points(expected, seen, options)
    described = np.zeros(len(aged), np.bool_)
    observations = feature_map.observations
    described[observations.point_index[observations.has_descriptor]] = True
    if not (aged & described).any():
        return feature_map
    before: dict[str, Any] = feature_map.provenance.get("aged", {})
    note = {"points": int((aged & described).sum()) + int(before.get("points", 0)), "sources": sources}
    return with_descriptors(feature_map, ~aged[observations.point_index], True, {"aged": note})
