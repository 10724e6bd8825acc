"""The story of growth on a database: new photos in, quarantined maps, confirmation, canaries, promoted maps.

Rounds: photos are localised by the active maps, reconstructions placed by them and committed in quarantine,
quarantined maps confirmed and promoted; then again, while something new was promoted that photos may see.
Every step is a commit of its own and can be repeated: a run that was killed is finished by the next.
"""

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

from featuredb.features.extractor import ExtractorOptions
from featuredb.store import Database, Snapshot
from featuredb.store.candidates.photos import mark_used
from ingest.colmap.bridge import Model
from ingest.fingerprint import digest
from ingest.growth.gates import figures
from ingest.growth.graph.map_graph import grow_within_budget, placed_maps
from ingest.growth.graph.replacing import replace_descendants
from ingest.growth.growth_report import GrowthReport, Run, fates_of, grown_entry, split_reason
from ingest.growth.not_found import NotFound, NotFoundRows
from ingest.growth.place.component import AT_SEVERAL_PLACES, GrownMap, grow_component, split
from ingest.growth.place.groups import lone_groups
from ingest.growth.place.localised import localise_photos, with_shared_lenses
from ingest.growth.trust.corroboration import NewPhotos
from ingest.growth.trust.promotion import promote_confirmed
from ingest.growth.trust.scan_check import checked_by_scan
from ingest.growth.unplaced import place_unplaced_maps
from ingest.growth.values import GrowthOptions, GrowthPhotos, LocalisedPhoto, Refused
from ingest.map_builder import MapIdentity
from ingest.photos.photo import Photo, shared_key
from ingest.sfm.links import keep_photos
from reloc.localiser import Localiser

_LOG = logging.getLogger(__name__)
# Part of every grown map's id; raised when the same photos would give another map.
_VERSION = "grown-1"
_MOST_ROUNDS = 10  # a bound on one run; each round needs a promotion
# A reconstruction whose photos are at several places is split where its photos share less than the first of
# these of their points, its parts at the second, and so on. 194 photos of a simulated town that look-alikes
# had joined from five places fell apart at 0.10 into parts of one place each, but for ten photos; at 0.25
# right ones do, too.
_SPLIT_LINKS = (0.10, 0.15, 0.25)


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
    options = options or GrowthOptions()
    started, clock = datetime.now(UTC), time.perf_counter()
    run, localiser = Run(lost=NotFoundRows(new.photos, new.features_of, work)), None
    for _ in range(_MOST_ROUNDS):
        run.rounds += 1
        replaced = replace_descendants(database, work, budget_m=options.drift_budget_m)
        if replaced is not None:
            run.replacements.append(replaced)
        localiser = Localiser.open(database, previous=localiser)
        placed, run.unplaced, notes = place_unplaced_maps(database, localiser.areas, work, options)
        run.entries.update({entry.map_id: entry for entry in placed})
        run.notes |= dict.fromkeys(notes)
        this = _Round(database=database, new=new, work=work, options=options, run=run, localiser=localiser)
        this.localise()
        this.place()
        if not this.promote():
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


@dataclass(slots=True, kw_only=True)
class _Round:
    """One round; `localised` photos are in no map; `posed`: those, lone ones of a camera with one lens."""

    database: Database
    new: GrowthPhotos
    work: Path
    options: GrowthOptions
    run: Run
    localiser: Localiser
    localised: dict[int, LocalisedPhoto] = field(default_factory=dict)
    posed: dict[int, LocalisedPhoto] = field(default_factory=dict)

    def localise(self) -> None:
        """Photos that maps did not show before are looked for in new maps only."""
        new, run, threads = self.new, self.run, self.options.threads
        served = {m.map_id for indexed in self.localiser.areas for m in indexed.area.maps}
        write_ids = {m.write_id: m.map_id for m in self.database.snapshot().maps() if m.map_id in served}
        rows = self._open_rows()
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
                areas = self.localiser.areas_of(tuple(sorted(write_ids[w] for w in fresh)))
                seen, _ = localise_photos(new.photos, asked, new.features_of, areas, threads)
                worth.extend(seen)
        self.localised, reasons = localise_photos(
            new.photos, sorted(worth), new.features_of, self.localiser.areas, threads
        )
        for row in rows:
            if row not in self.localised:
                reason = reasons.get(row) or run.lost.known[row].reason
                run.lost.note(row, NotFound(maps=frozenset(write_ids), reason=reason))
                run.why[row] = split_reason(reason)

    def place(self) -> None:
        """Reconstructions and lone photos; what passes is committed."""
        new, run = self.new, self.run
        self.posed = dict(self.localised)
        run.refused.clear()
        for model in new.models():
            part = keep_photos(model, [int(r) for r in model.rows if int(r) not in run.map_of])
            if part is not None and any(int(r) in self.localised for r in part.rows):
                self._try_model(part, _SPLIT_LINKS)
        left = {row: photo for row, photo in self.localised.items() if row not in run.map_of}
        lone = with_shared_lenses(left, {row: shared_key(new.photos[row], "shared") for row in left})
        groups, waiting = lone_groups(lone, new.features_of, new.overlaps, new.geometry_of)
        self.posed |= lone
        for group in groups:
            self._try_model(group, ())
        run.why.update({row: split_reason(reason) for row, reason in waiting.items()})

    def promote(self) -> bool:
        """Confirm and promote; whether anything was."""
        new, run = self.new, self.run
        outside = NewPhotos(
            photos=new.photos,
            rows=self._open_rows(),
            features_of=new.features_of,
            localised=self.localised,
            heard=run.heard,
            overlaps=new.overlaps,
        )
        outcomes = promote_confirmed(
            self.database,
            self.localiser,
            self.options.trusted,
            outside,
            budget_m=self.options.drift_budget_m,
            work=self.work,
            threads=self.options.threads,
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
                    gates={**entry.gates, **figures(outcome.gates)},
                )
        return any(outcome.promoted for outcome in outcomes)

    def _open_rows(self) -> list[int]:
        """Photos that are in no map yet."""
        return [row for row in range(len(self.new.photos)) if row not in self.run.map_of]

    def _try_model(self, model: Model, links: Sequence[float]) -> None:
        """Place one reconstruction; where it reaches beyond the drift budget, the part of it that does not.

        Where its photos are at several places, its parts: look-alikes join what does not belong together.

        Args:
            links: at which it may be split, weakest first.
        """
        outcome = self._grown(model)
        if isinstance(outcome, GrownMap):
            self._take(outcome)
            return
        part = keep_photos(model, list(outcome.rows)) if outcome.reason in AT_SEVERAL_PLACES else None
        pieces = None if part is None else split(part, links)
        if pieces is None:
            self.run.note_refusal(outcome, self.new.photos)
            return
        level, parts = pieces
        count, message = len(outcome.rows), outcome.message
        _LOG.info("%d photos are at several places: %s; apart at links of %g", count, message, level)
        for piece in parts:
            rows = tuple(int(r) for r in piece.rows)
            if self.posed.keys() & rows:
                self._try_model(piece, [link for link in links if link > level])
            else:
                self.run.note_refusal(replace(outcome, rows=rows), self.new.photos)

    def _grown(self, model: Model) -> GrownMap | Refused:
        """The map of a reconstruction within the drift budget."""
        new, budget_m = self.new, self.options.drift_budget_m

        def grown(part: Model) -> GrownMap | Refused:
            identity = _identity([new.photos[int(r)] for r in part.rows])
            return grow_component(
                part, new.photos, new.features_of, self.posed, self.localiser.areas, identity, budget_m
            )

        return grow_within_budget(model, grown, placed_maps(self.database.snapshot()), budget_m)

    def _take(self, grown: GrownMap) -> None:
        """Commit a grown map in quarantine, unless a scan or a person who retired it are against it."""
        database, new, run = self.database, self.new, self.run
        rows = [int(r) for r in grown.model.rows]
        feature_map, scan, unasked = checked_by_scan(database, grown.feature_map)
        grown = replace(grown, feature_map=feature_map)
        run.notes |= {unasked: None} if unasked else {}
        why = None if scan is None or scan.passes else (scan.reason, scan.message)
        known = {m.map_id: m for m in database.snapshot().maps(include_retired=True)}.get(feature_map.map_id)
        if why is None and known is not None and known.status == "retired":
            why = "RETIRED_MAP", f"map {known.map_id} of these photos was retired: {known.status_reason}"
        if why is not None:
            run.refused.append(grown_entry(grown, "refused", *why))
            run.why.update(dict.fromkeys(rows, why))
            return
        used = [new.candidate_ids[r] for r in rows if r in new.candidate_ids]
        if used:
            mark_used(database, used, feature_map.map_id)
        database.commit_map(feature_map)
        run.map_of.update(dict.fromkeys(rows, feature_map.map_id))
        for row in rows:
            run.why.pop(row, None)
        run.why.update({row: why for row, why in grown.left_out.items() if row not in run.map_of})
        run.entries[feature_map.map_id] = grown_entry(grown)
        _LOG.info("map %s: %d photos in quarantine", feature_map.map_id, len(rows))


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
