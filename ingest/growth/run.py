"""The story of growth on a database: new photos in, quarantined maps, confirmation, canaries, promoted maps.

Rounds: photos are localised by the active maps, reconstructions placed by them and committed in quarantine,
quarantined maps confirmed and promoted; then again, while something new was promoted. Every step is a commit
of its own and can be repeated: a run that was killed is finished by the next.
"""

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

from featuredb.store import Database
from featuredb.store.candidates.photos import mark_used
from featuredb.store.candidates.states import OPERATOR
from ingest.colmap.bridge import Model
from ingest.growth.asked_before import recall, remember
from ingest.growth.graph.map_graph import grow_within_budget, placed_maps
from ingest.growth.graph.replacing import Replacement, replace_descendants
from ingest.growth.growth_report import GrownEntry, GrowthReport, PhotoFate, grown_entry, refused_entry
from ingest.growth.place.component import AT_SEVERAL_PLACES, GrownMap, lone_groups, split
from ingest.growth.place.localised import localise_photos, with_shared_lenses
from ingest.growth.place.refine import LEAST_LINK
from ingest.growth.trust.confirmation import NewPhotos
from ingest.growth.trust.promotion import Promotion, promote_confirmed
from ingest.growth.trust.scan_check import checked_by_scan
from ingest.growth.unplaced import place_unplaced_maps
from ingest.growth.values import GrowthOptions, GrowthPhotos, LocalisedPhoto, Refused
from ingest.photos.photo import shared_key
from ingest.sfm.links import keep_photos
from reloc.localiser import Localiser

_LOG = logging.getLogger(__name__)
# A reconstruction whose photos are at several places is split where its photos share less than the first of
# these of their points, its parts at the second, and so on. 194 photos of a simulated town that look-alikes
# had joined from five places fell apart at 0.10 into parts of one place each, but for ten photos; at 0.25
# right ones do, too, and no photo needs more.
_SPLIT_LINKS = (0.10, 0.15, LEAST_LINK)


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
    started, clock = datetime.now(UTC), time.perf_counter()
    extractor = new.features_of(0).features.fingerprint if new.photos else ""  # of all of them
    run = _Run(database=database, new=new, work=work, options=options or GrowthOptions(), extractor=extractor)
    while True:  # each round but the last promotes a map that no round before it did
        run.start_round()
        run.localise()
        run.place()
        if not run.promote():
            break
    return run.report(started, time.perf_counter() - clock)


@dataclass(slots=True, kw_only=True)
class _Run:
    """A run as far as it has come; rows are those of the new photos.

    Attributes:
        localiser: of the maps that are active in this round.
        localised: photos that are in no map, as these maps see them; `posed`: the same, lone ones of a camera
            with one lens.
        map_of: maps that photos are in; why: code and reason of those that are in none.
        entries: maps that this run has made; refused, unplaced: what this round could not place.
        promotions: the last word on each quarantined map.
    """

    database: Database
    new: GrowthPhotos
    work: Path
    options: GrowthOptions
    extractor: str
    rounds: int = 0
    localiser: Localiser = field(init=False)
    localised: dict[int, LocalisedPhoto] = field(default_factory=dict)
    posed: dict[int, LocalisedPhoto] = field(default_factory=dict)
    heard: dict[tuple[str, int], LocalisedPhoto | None] = field(default_factory=dict)
    map_of: dict[int, str] = field(default_factory=dict)
    why: dict[int, tuple[str, str]] = field(default_factory=dict)
    entries: dict[str, GrownEntry] = field(default_factory=dict)
    refused: list[GrownEntry] = field(default_factory=list)
    unplaced: list[GrownEntry] = field(default_factory=list)
    promotions: dict[str, Promotion] = field(default_factory=dict)
    ever_promoted: set[str] = field(default_factory=set)
    replacements: list[Replacement] = field(default_factory=list)
    notes: dict[str, None] = field(default_factory=dict)

    def start_round(self) -> None:
        """New anchors move what was grown, and maps without a place are tried."""
        self.rounds += 1
        replaced = replace_descendants(self.database, self.work, budget_m=self.options.drift_budget_m)
        self.replacements += [replaced] if replaced else []
        self.localiser = Localiser.open(self.database, previous=self.localiser if self.rounds > 1 else None)
        areas = self.localiser.areas
        tried, notes = place_unplaced_maps(self.database, areas, self.work, self.options)
        self.unplaced = [entry for entry in tried if entry.status == "unplaced"]
        self.entries |= {entry.map_id: entry for entry in tried if entry.status != "unplaced"}
        self.notes |= dict.fromkeys(notes)

    def localise(self) -> None:
        """Photos that maps did not show before are looked for in new maps, and if one shows them, in all."""
        new, threads = self.new, self.options.threads
        served = {m.map_id for indexed in self.localiser.areas for m in indexed.area.maps}
        write_ids = {m.write_id: m.map_id for m in self.database.snapshot().maps() if m.map_id in served}
        rows, everywhere = self._open_rows(), frozenset(write_ids)
        before = {row: recall(self.work, "photos", self._about(row)) or {} for row in rows}
        asked: dict[frozenset[str], list[int]] = {}
        for row in rows:
            maps = frozenset(before[row].get("maps", ()))  # a map that was moved is another one
            asked.setdefault(everywhere - maps if maps <= everywhere else everywhere, []).append(row)
        worth = asked.pop(everywhere, [])
        asked.pop(frozenset(), None)
        for fresh, again in asked.items():
            areas = self.localiser.areas_of(tuple(sorted(write_ids[w] for w in fresh)))
            worth += localise_photos(new, again, areas, threads)[0]
        self.localised, reasons = localise_photos(new, sorted(worth), self.localiser.areas, threads)
        for row in rows:
            if row not in self.localised:
                reason = reasons.get(row) or before[row]["reason"]
                answer = {"maps": sorted(everywhere), "reason": reason}
                self.why[row] = _split_reason(reason)
                if answer != before[row]:
                    remember(self.work, "photos", self._about(row), answer)

    def place(self) -> None:
        """Reconstructions and lone photos; what passes is committed."""
        new = self.new
        self.posed = dict(self.localised)
        self.refused.clear()
        for model in new.models():
            part = keep_photos(model, [row for row in model.rows.tolist() if row not in self.map_of])
            if part is not None and self.localised.keys() & part.rows.tolist():
                self._try_model(part, _SPLIT_LINKS)
        left = {row: photo for row, photo in self.localised.items() if row not in self.map_of}
        lone = with_shared_lenses(left, {row: shared_key(new.photos[row], "shared") for row in left})
        groups, waiting = lone_groups(lone, new)
        self.posed |= lone
        for group in groups:
            self._try_model(group, ())
        self.why.update({row: _split_reason(reason) for row, reason in waiting.items()})

    def promote(self) -> bool:
        """Confirm and promote; whether a map was that this run had not promoted before.

        A map that goes back to quarantine and is promoted again, round by round, would keep the run going.
        """
        new = NewPhotos(given=self.new, rows=self._open_rows(), localised=self.localised, heard=self.heard)
        outcomes = promote_confirmed(self.database, self.localiser, self.options, self.work, new)
        for outcome in outcomes:
            self.promotions[outcome.map_id] = outcome
            entry = self.entries.get(outcome.map_id)
            if entry is not None:
                self.entries[outcome.map_id] = replace(
                    entry,
                    status="active" if outcome.promoted else "quarantined",
                    reason_code=outcome.reason_code,
                    reason=outcome.reason,
                    gates={**entry.gates, **outcome.gates},
                )
        first = {outcome.map_id for outcome in outcomes if outcome.promoted} - self.ever_promoted
        self.ever_promoted |= first
        return bool(first)

    def report(self, started: datetime, seconds: float) -> GrowthReport:
        active = {m.map_id for m in self.database.snapshot().maps() if m.status == "active"}
        return GrowthReport(
            database=self.database.url,
            started=started,
            seconds=seconds,
            rounds=self.rounds,
            version=self.database.poll_version(),
            photos=tuple(self._fate(row, active) for row in range(len(self.new.photos))),
            maps=(*self.entries.values(), *self.refused, *self.unplaced),
            promotions=tuple(self.promotions.values()),
            replacements=tuple(self.replacements),
            notes=tuple(self.notes),
        )

    def _fate(self, row: int, active: set[str]) -> PhotoFate:
        photo, map_id = self.new.photos[row], self.map_of.get(row, "")
        code, reason = self.why.get(row, ("", ""))
        if map_id and not code and map_id not in active and map_id in self.promotions:
            code, reason = self.promotions[map_id].reason_code, self.promotions[map_id].reason
        return PhotoFate(
            name=self.new.candidate_ids.get(row, photo.name),
            owner=photo.contributor or OPERATOR,
            outcome="waiting" if not map_id else "promoted" if map_id in active else "quarantined",
            map_id=map_id,
            reason_code=code,
            reason=reason,
        )

    def _about(self, row: int) -> str:
        """A photo with all by which it is looked for."""
        photo = self.new.photos[row]
        told = photo.gps, photo.focal_px, photo.camera_key
        return f"{photo.sha256} {told!r} {self.extractor}"

    def _open_rows(self) -> list[int]:
        """Photos that are in no map yet."""
        return [row for row in range(len(self.new.photos)) if row not in self.map_of]

    def _try_model(self, model: Model, links: Sequence[float]) -> None:
        """Place one reconstruction, or the part of it that is within the drift budget.

        Where its photos are at several places, its parts, split at `links`, weakest first.
        """
        maps, budget_m = placed_maps(self.database.snapshot()), self.options.drift_budget_m
        grown = grow_within_budget(model, self.new, self.posed, self.localiser.areas, maps, budget_m)
        if isinstance(grown, GrownMap):
            self._take(grown)
            return
        level, parts = split(model, links) if grown.reason in AT_SEVERAL_PLACES else (0.0, [])
        if not level:
            self._note(grown, model)
            return
        count, message = len(model.rows), grown.message
        _LOG.info("%d photos are at several places: %s; apart at links of %g", count, message, level)
        for part in parts:
            if self.posed.keys() & part.rows.tolist():
                self._try_model(part, [link for link in links if link > level])
            else:
                self._note(grown, part)

    def _take(self, grown: GrownMap) -> None:
        """Commit a grown map in quarantine, unless a scan or a person who retired it are against it."""
        checked, note = checked_by_scan(self.database, grown)
        self.notes |= {note: None} if note else {}
        if isinstance(checked, Refused):
            self._note(checked, grown.model)
            return
        feature_map, rows = checked.feature_map, checked.model.rows.tolist()
        every = {m.map_id: m for m in self.database.snapshot().maps(include_retired=True)}
        known = every.get(feature_map.map_id)
        if known is not None and known.status == "retired":
            message = f"map {known.map_id} of these photos was retired: {known.status_reason}"
            self._note(Refused(reason="RETIRED_MAP", message=message), grown.model)
            return
        used = [self.new.candidate_ids[r] for r in rows if r in self.new.candidate_ids]
        mark_used(self.database, used, feature_map.map_id)
        self.database.commit_map(feature_map)
        self.map_of |= dict.fromkeys(rows, feature_map.map_id)
        reasons = {**self.why, **grown.left_out}
        self.why = {row: why for row, why in reasons.items() if row not in self.map_of}
        self.entries[feature_map.map_id] = grown_entry(feature_map)
        _LOG.info("map %s: %d photos in quarantine", feature_map.map_id, len(rows))

    def _note(self, refused: Refused, model: Model) -> None:
        """What photos became no map, and why."""
        rows = model.rows.tolist()
        self.why.update(dict.fromkeys(rows, (refused.reason, refused.message)))
        names = tuple(self.new.photos[r].name for r in rows)
        self.refused.append(refused_entry(refused, "refused", photos=names))


def _split_reason(reason: str) -> tuple[str, str]:
    code, _, text = reason.partition(": ")
    return code, text or code
