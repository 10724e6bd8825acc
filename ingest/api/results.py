"""What the methods of a database give back: values that a notebook shows."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path

from featuredb.cli.database import maps_table, unplaced_text
from featuredb.maps.place_bounds import PlaceBounds
from featuredb.store import MapSummary, UnplacedSummary
from ingest.anchoring import Anchoring
from ingest.api.ingesting import summary
from ingest.api.registering import ControlledMap
from ingest.api.tracking import TrackedFilm
from ingest.growth.growth_report import GrowthReport
from ingest.html_parts import picture
from ingest.plot_parts import plan_png
from ingest.report.values import IngestReport


class _Shown:
    """What a notebook shows as it is printed."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"


@dataclass(frozen=True, slots=True, kw_only=True)
class ListedMaps(_Shown):
    """The maps of a database at one version; those without a place come last.

    Attributes:
        bounds: of each placed map, by id.
    """

    placed: tuple[MapSummary, ...]
    unplaced: tuple[UnplacedSummary, ...]
    bounds: Mapping[str, PlaceBounds]

    def __getitem__(self, row: int) -> MapSummary | UnplacedSummary:
        return list(self)[row]

    def __len__(self) -> int:
        return len(self.placed) + len(self.unplaced)

    def __iter__(self) -> Iterator[MapSummary | UnplacedSummary]:
        yield from self.placed
        yield from self.unplaced

    def __str__(self) -> str:
        return maps_table(self.placed, self.bounds) + unplaced_text(self.unplaced)

    def __repr__(self) -> str:
        return str(self)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ingested(_Shown):
    """What an ingest did with every file and map; `report` has the figures."""

    report: IngestReport

    @property
    def map_ids(self) -> tuple[str, ...]:
        """Of the maps that are in the database now, largest first."""
        return tuple(outcome.map_id for outcome in self.report.maps if outcome.map_id)

    def __str__(self) -> str:
        return summary(self.report)

    def _repr_html_(self) -> str:
        plans = (picture(plan_png(m.plan), m.name) for m in self.report.maps if m.plan is not None)
        return _Shown._repr_html_(self) + "".join(plans)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Aligned(_Shown):
    """A map that was to be placed, and by what.

    Attributes:
        placed: whether it is in the database at its new place.
        report: of the scan, of the control points, or of the maps that placed it.
        page: HTML with pictures to decide by; None where there is none.
    """

    map_id: str
    placed: bool
    report: Anchoring | ControlledMap | GrowthReport
    text: str
    page: Path | None = None

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilmTrack(_Shown):
    """The poses of a film's frames; `film.video.trajectory.points` has each with its covariance."""

    film: TrackedFilm

    def __str__(self) -> str:
        return self.film.as_text()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Grown(_Shown):
    """What became of contributed photos and of maps without a place."""

    report: GrowthReport

    def __str__(self) -> str:
        return self.report.as_text()
