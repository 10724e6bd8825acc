"""What a run of growth goes by, its new photos, and what has come of them so far: maps, refusals, reasons."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from featuredb.store import Snapshot
from featuredb.store.candidates.states import OPERATOR
from ingest.colmap.bridge import Model
from ingest.growth.gates import figures
from ingest.growth.graph.replacing import Replacement
from ingest.growth.growth_report import GrownEntry, PhotoFate
from ingest.growth.map_places import growth_of
from ingest.growth.not_found import NotFoundRows
from ingest.growth.trust.confirmation import ConfirmationOptions
from ingest.growth.trust.promotion import Promotion
from ingest.growth.values import FeaturesOf, GrownMap, LocalisedPhoto, Refused
from ingest.photos.photo import Photo
from ingest.sfm.extract import PhotoFeatures
from ingest.sfm.pairs import Pair


@dataclass(frozen=True, slots=True, kw_only=True)
class GrowthOptions:
    """How a database grows.

    Attributes:
        drift_budget_m: 95 % bound on a map's errors against its anchors beyond which it is not taken: what
            a survey's points are usually wanted for. Photos beyond it wait for an anchor.
        threads: photos that are localised at a time.
    """

    drift_budget_m: float = 0.5
    confirmation: ConfirmationOptions = field(default_factory=ConfirmationOptions)
    threads: int = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GrowthPhotos:
    """New photos, matched and reconstructed.

    Attributes:
        models: their reconstructions, called once a round; rows of a model are rows of `photos`.
        candidate_ids: of contributed photos, by row.
        overlaps: pairs of rows whose matches were verified; None: not known.
    """

    photos: Sequence[Photo]
    features_of: FeaturesOf
    models: Callable[[], Iterable[Model]]
    candidate_ids: Mapping[int, str] = field(default_factory=dict)
    overlaps: Collection[Pair] | None = None


def no_photos() -> GrowthPhotos:
    """Nothing new: old quarantined maps are examined, and new anchors looked for."""

    def none(row: int) -> PhotoFeatures:
        raise IndexError(f"there is no photo {row}")

    return GrowthPhotos(photos=(), features_of=none, models=lambda: ())


@dataclass(slots=True, kw_only=True)
class Run:
    """What a run has come to; rows of the new photos."""

    map_of: dict[int, str] = field(default_factory=dict)
    why: dict[int, tuple[str, str]] = field(default_factory=dict)
    entries: dict[str, GrownEntry] = field(default_factory=dict)
    refused: list[GrownEntry] = field(default_factory=list)
    unplaced: tuple[GrownEntry, ...] = ()
    promotions: dict[str, Promotion] = field(default_factory=dict)
    replacements: list[Replacement] = field(default_factory=list)
    notes: dict[str, None] = field(default_factory=dict)
    heard: dict[tuple[str, int], LocalisedPhoto | None] = field(default_factory=dict)
    lost: NotFoundRows
    rounds: int = 0

    def note_refusal(self, refused: Refused, photos: Sequence[Photo]) -> None:
        rows = [r for r in refused.rows if r not in self.map_of]
        self.why.update(dict.fromkeys(rows, (refused.reason, refused.message)))
        self.refused.append(
            GrownEntry(
                map_id="",
                status="refused",
                reason_code=refused.reason,
                reason=refused.message,
                photos=tuple(photos[r].name for r in rows),
                gates=figures(refused.gates),
            )
        )


def grown_entry(grown: GrownMap, status: str = "quarantined", code: str = "", reason: str = "") -> GrownEntry:
    feature_map = grown.feature_map
    growth = growth_of(feature_map.placement.evidence)
    return GrownEntry(
        map_id=feature_map.map_id,
        status=status,
        reason_code=code,
        reason=reason,
        photos=tuple(image.name for image in feature_map.images),
        points=len(feature_map.points),
        parents=feature_map.parents,
        generation=feature_map.generation,
        steps=growth.get("steps"),
        drift_m=growth.get("drift_m"),
        budget_m=growth.get("budget_m"),
        gates=growth.get("gates", {}),
        agreements=tuple(grown.agreements),
    )


def fates_of(new: GrowthPhotos, run: Run, snapshot: Snapshot) -> tuple[PhotoFate, ...]:
    active = {m.map_id for m in snapshot.maps() if m.status == "active"}
    fates = []
    for row, photo in enumerate(new.photos):
        map_id = run.map_of.get(row, "")
        code, reason = run.why.get(row, ("", ""))
        if map_id and not code and map_id not in active and map_id in run.promotions:
            code, reason = run.promotions[map_id].reason_code, run.promotions[map_id].reason
        fates.append(
            PhotoFate(
                name=new.candidate_ids.get(row, photo.name),
                owner=photo.contributor or OPERATOR,
                outcome="waiting" if not map_id else "promoted" if map_id in active else "quarantined",
                map_id=map_id,
                reason_code=code,
                reason=reason,
            )
        )
    return tuple(fates)


def split_reason(reason: str) -> tuple[str, str]:
    code, _, text = reason.partition(": ")
    return code, text or code
