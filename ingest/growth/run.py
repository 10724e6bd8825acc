"""The story of growth on a database: new photos in, quarantined maps, confirmation, canaries, promoted maps.

Rounds: photos are localised by the active maps, reconstructions placed by them and committed in quarantine,
quarantined maps confirmed and promoted; then again, while something new was promoted that photos may see.
Every step is a commit of its own and can be repeated: a run that was killed is finished by the next.
"""

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

from featuredb.features.extractor import ExtractorOptions
from featuredb.store import Database, Snapshot
from featuredb.store.candidates.photos import mark_used
from ingest.colmap.bridge import Model
from ingest.fingerprint import digest
from ingest.growth.graph.budget import grow_within_budget
from ingest.growth.graph.map_graph import placed_maps
from ingest.growth.graph.replacing import ReplaceOptions, replace_descendants
from ingest.growth.growth_report import GrowthReport
from ingest.growth.not_found import NotFound, NotFoundRows
from ingest.growth.place.component import AT_SEVERAL_PLACES, GrowOptions, grow_component, split
from ingest.growth.place.groups import GroupOptions, lone_groups
from ingest.growth.place.localised import LocaliseEachOptions, localise_photos, with_shared_lenses
from ingest.growth.run_record import (
    GrowthPhotos,
    Run,
    fates_of,
    grown_entry,
    note_refusal,
    split_reason,
)
from ingest.growth.trust.corroboration import NewPhotos
from ingest.growth.trust.promotion import PromotionOptions, promote_confirmed
from ingest.growth.trust.scan_check import ScanCheckOptions, scan_gate, with_gate
from ingest.growth.unplaced import PlaceUnplacedOptions, place_unplaced_maps
from ingest.growth.values import GrownMap, LocalisedPhoto, Refused
from ingest.map_builder import MapIdentity
from ingest.photos.photo import Photo, shared_key
from ingest.sfm.links import keep_photos
from reloc.localise.candidates import IndexedArea
from reloc.localiser import Localiser

_LOG = logging.getLogger(__name__)
# Part of every grown map's id; raised when the same photos would give another map.
_VERSION = "grown-1"


@dataclass(frozen=True, slots=True, kw_only=True)
class GrowthOptions:
    """How a database grows.

    Attributes:
        drift_budget_m: 95 % bound on a map's errors against its anchors beyond which it is not taken: what
            a survey's points are usually wanted for. Photos beyond it wait for an anchor.
        max_rounds: a bound on one run; each round needs a promotion.
        split_links: a reconstruction whose photos are at several places is split where its photos share
            less than the first of these of their points, its parts at the second, and so on. 194 photos
            of a simulated town that look-alikes had joined from five places fell apart at 0.10 into parts
            of one place each, but for ten photos; at 0.25 (`RefinementOptions.min_link`) right ones do, too.
        localise, grow, groups, scan, promotion, replacing: of the steps.
    """

    drift_budget_m: float = 0.5
    max_rounds: int = 10
    split_links: tuple[float, ...] = (0.10, 0.15, 0.25)
    localise: LocaliseEachOptions = field(default_factory=LocaliseEachOptions)
    grow: GrowOptions = field(default_factory=GrowOptions)
    groups: GroupOptions = field(default_factory=GroupOptions)
    scan: ScanCheckOptions = field(default_factory=ScanCheckOptions)
    promotion: PromotionOptions = field(default_factory=PromotionOptions)
    replacing: ReplaceOptions = field(default_factory=ReplaceOptions)

    def with_threads(self, threads: int) -> "GrowthOptions":
        """The same with so many photos localised at a time."""
        localise = replace(self.localise, threads=threads)
        corroboration = self.promotion.corroboration
        corroboration = replace(corroboration, localise=replace(corroboration.localise, threads=threads))
        return replace(
            self, localise=localise, promotion=replace(self.promotion, corroboration=corroboration)
        )

    def with_budget(self) -> "GrowthOptions":
        """The same where no photo of a map may be further off than the budget either."""
        refinement = replace(self.grow.refinement, max_photo_bound_m=self.drift_budget_m)
        return replace(self, grow=replace(self.grow, refinement=refinement))


def extractor_for(snapshot: Snapshot, options: ExtractorOptions) -> ExtractorOptions:
    """The options whose descriptors fit the active maps': most maps decide whether they are upright."""
    active = [m for m in snapshot.maps() if m.status == "active"]
    upright = sum("-upright-" in m.extractor_fingerprint for m in active)
    return replace(options, upright=upright > len(active) / 2) if active else options


def grow(
    database: Database, new: GrowthPhotos, work: Path, options: GrowthOptions | None = None
) -> GrowthReport:
    """Let a database grow by new photos and maps without a place, in rounds, as far as they carry.

    Args:
        work: the database's work folder, for what is measured once.

    Raises:
        ConflictError: others changed the same maps too often; what is committed stands.
        StoreError
    """
    options = (options or GrowthOptions()).with_budget()
    started, clock = datetime.now(UTC), time.perf_counter()
    run, localiser = Run(lost=NotFoundRows(new.photos, new.features_of, work, options.localise)), None
    for _ in range(options.max_rounds):
        run.rounds += 1
        replaced = replace_descendants(database, work, options.replacing, budget_m=options.drift_budget_m)
        if replaced is not None:
            run.replacements.append(replaced)
        localiser = Localiser.open(database, previous=localiser)
        _place_unplaced(database, localiser.areas, run, options, work)
        localised = _round(database, new, localiser, run, options)
        if not _promote(database, new, localiser, localised, run, options, work):
            break
    return GrowthReport(
        database=database.url,
        started=started,
        seconds=time.perf_counter() - clock,
        rounds=run.rounds,
        version=database.poll_version(),
        photos=fates_of(new, run, database.snapshot()),
        maps=(*run.entries.values(), *run.refused, *run.unplaced),
        promotions=tuple(run.promotions.values()),
        replacements=tuple(run.replacements),
        notes=tuple(run.notes),
    )


def _round(
    database: Database, new: GrowthPhotos, localiser: Localiser, run: Run, options: GrowthOptions
) -> dict[int, LocalisedPhoto]:
    """Localise what is not in a map yet, place reconstructions and lone photos, commit what passes."""
    open_rows = [row for row in range(len(new.photos)) if row not in run.map_of]
    localised = _localise(database, new, open_rows, localiser, run, options)
    run.why.update(
        {row: split_reason(run.lost.known[row].reason) for row in open_rows if row not in localised}
    )
    run.refused.clear()
    for model in new.models():
        part = keep_photos(model, [int(r) for r in model.rows if int(r) not in run.map_of])
        if part is None or not any(int(r) in localised for r in part.rows):
            continue
        _try_model(database, part, new, localised, localiser.areas, run, options)
    left = {row: photo for row, photo in localised.items() if row not in run.map_of}
    keys = {row: shared_key(new.photos[row], "shared") for row in left}
    lone = with_shared_lenses(left, keys, options.grow.localise)
    groups, waiting = lone_groups(lone, new.features_of, options.groups)
    for group in groups:
        _try_model(database, group, new, lone, localiser.areas, run, options, links=())
    run.why.update({row: split_reason(reason) for row, reason in waiting.items()})
    return localised


def _place_unplaced(
    database: Database, areas: Sequence[IndexedArea], run: Run, options: GrowthOptions, work: Path
) -> None:
    """Maps without a place that the active ones show; what is placed is examined with the new maps."""
    steps = PlaceUnplacedOptions(
        drift_budget_m=options.drift_budget_m,
        localise=options.localise,
        grow=options.grow,
        scan=options.scan,
    )
    done = place_unplaced_maps(database, areas, work, steps)
    run.entries.update({entry.map_id: entry for entry in done.placed})
    run.unplaced = done.unplaced
    run.notes += [note for note in done.notes if note not in run.notes]


def _localise(
    database: Database,
    new: GrowthPhotos,
    rows: Sequence[int],
    localiser: Localiser,
    run: Run,
    options: GrowthOptions,
) -> dict[int, LocalisedPhoto]:
    """What the active maps show; photos that they did not show before are looked for in new maps only."""
    served = {m.map_id for indexed in localiser.areas for m in indexed.area.maps}
    write_ids = {m.write_id: m.map_id for m in database.snapshot().maps() if m.map_id in served}
    worth: list[int] = []
    again: dict[frozenset[str], list[int]] = {}
    for row in rows:
        before = run.lost.known.get(row)
        if before is None or not before.maps <= write_ids.keys():
            worth.append(row)
        else:
            again.setdefault(frozenset(write_ids.keys() - before.maps), []).append(row)
    for fresh, asked in again.items():
        if fresh:
            areas = localiser.areas_of(tuple(sorted(write_ids[w] for w in fresh)))
            seen, _ = localise_photos(new.photos, asked, new.features_of, areas, options.localise)
            worth.extend(seen)
    localised, reasons = localise_photos(
        new.photos, sorted(worth), new.features_of, localiser.areas, options.localise
    )
    for row in rows:
        if row not in localised:
            reason = reasons.get(row) or run.lost.known[row].reason
            run.lost.note(row, NotFound(maps=frozenset(write_ids), reason=reason))
    return localised


def _try_model(
    database: Database,
    model: Model,
    new: GrowthPhotos,
    localised: Mapping[int, LocalisedPhoto],
    areas: Sequence[IndexedArea],
    run: Run,
    options: GrowthOptions,
    links: Sequence[float] | None = None,
) -> None:
    """Place one reconstruction; where it reaches beyond the drift budget, the part of it that does not.

    Where its photos are at several places, its parts: look-alikes join what does not belong together.

    Args:
        links: at which it may be split, weakest first.
    """
    outcome = _grown(database, model, new, localised, areas, options)
    if not isinstance(outcome, Refused):
        _take(database, outcome, new, run, options)
        return
    links = options.split_links if links is None else links
    part = keep_photos(model, list(outcome.rows)) if outcome.reason in AT_SEVERAL_PLACES else None
    pieces = None if part is None else split(part, links)
    if pieces is None:
        note_refusal(outcome, new, run)
        return
    level, parts = pieces
    count, message = len(outcome.rows), outcome.message
    _LOG.info("%d photos are at several places: %s; apart at links of %g", count, message, level)
    for piece in parts:
        if any(int(r) in localised for r in piece.rows):
            rest = [link for link in links if link > level]
            _try_model(database, piece, new, localised, areas, run, options, rest)
        else:
            note_refusal(replace(outcome, rows=tuple(int(r) for r in piece.rows)), new, run)


def _take(database: Database, grown: GrownMap, new: GrowthPhotos, run: Run, options: GrowthOptions) -> None:
    """Commit a grown map in quarantine, unless a scan or a person who retired it are against it."""
    snapshot, feature_map = database.snapshot(), grown.feature_map
    rows = [int(r) for r in grown.model.rows]
    names = tuple(new.photos[r].name for r in rows)
    scan, unasked = scan_gate(database, feature_map, options.scan)
    run.notes += [unasked] if unasked and unasked not in run.notes else []
    if scan is not None:
        feature_map = with_gate(feature_map, scan)
        if not scan.passes:
            run.refused.append(grown_entry(feature_map, grown, names, "refused", scan.reason, scan.message))
            run.why.update(dict.fromkeys(rows, (scan.reason, scan.message)))
            return
    known = {m.map_id: m for m in snapshot.maps(include_retired=True)}.get(feature_map.map_id)
    if known is not None and known.status == "retired":
        reason = f"map {known.map_id} of these photos was retired: {known.status_reason}"
        run.refused.append(grown_entry(feature_map, grown, names, "refused", "RETIRED_MAP", reason))
        run.why.update(dict.fromkeys(rows, ("RETIRED_MAP", reason)))
        return
    used = [new.candidate_ids[r] for r in rows if r in new.candidate_ids]
    if used:
        mark_used(database, used, feature_map.map_id)
    database.commit_map(feature_map)
    run.map_of.update(dict.fromkeys(rows, feature_map.map_id))
    for row in rows:
        run.why.pop(row, None)
    run.why.update({row: why for row, why in grown.left_out.items() if row not in run.map_of})
    run.entries[feature_map.map_id] = grown_entry(feature_map, grown, names, "quarantined", "", "")
    _LOG.info("map %s: %d photos in quarantine", feature_map.map_id, len(rows))


def _promote(
    database: Database,
    new: GrowthPhotos,
    localiser: Localiser,
    localised: dict[int, LocalisedPhoto],
    run: Run,
    options: GrowthOptions,
    work: Path,
) -> bool:
    """Confirm and promote; whether anything was."""
    outside = NewPhotos(
        photos=new.photos,
        rows=[row for row in range(len(new.photos)) if row not in run.map_of],
        features_of=new.features_of,
        localised=localised,
        heard=run.heard,
        overlaps=new.overlaps,
    )
    outcomes = promote_confirmed(
        database, localiser, options.promotion, outside, budget_m=options.drift_budget_m, work=work
    )
    for outcome in outcomes:
        run.promotions[outcome.map_id] = outcome
        entry = run.entries.get(outcome.map_id)
        if entry is not None:
            run.entries[outcome.map_id] = replace(
                entry,
                status="active" if outcome.promoted else "quarantined",
                reason_code=outcome.reason_code,
                reason=outcome.reason,
                gates={**entry.gates, **{g.name: g.as_json() for g in outcome.gates}},
            )
    return any(outcome.promoted for outcome in outcomes)


def _grown(
    database: Database,
    model: Model,
    new: GrowthPhotos,
    localised: Mapping[int, LocalisedPhoto],
    areas: Sequence[IndexedArea],
    options: GrowthOptions,
) -> GrownMap | Refused:
    """The map of a reconstruction within the drift budget."""

    def grown(part: Model) -> GrownMap | Refused:
        identity = _identity([new.photos[int(r)] for r in part.rows])
        return grow_component(part, new.photos, new.features_of, localised, areas, identity, options.grow)

    return grow_within_budget(model, grown, placed_maps(database.snapshot()), options.drift_budget_m)


def _identity(photos: Sequence[Photo]) -> MapIdentity:
    """A map is named by its photos: the same photos give the same map."""
    key = digest(_VERSION, *sorted(p.sha256 for p in photos))[:20]
    return MapIdentity(
        map_id=f"g{key}",
        name=f"grown {key[:6]}",
        source="growth",
        licence=", ".join(sorted({p.licence for p in photos if p.licence})),
        provenance={"version": _VERSION, "photos": len(photos)},
    )
