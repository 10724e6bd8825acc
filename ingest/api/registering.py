"""A map placed by control points, from the database to the database."""

from dataclasses import dataclass
from pathlib import Path

from featuredb.maps.unplaced_map import UnplacedMap
from featuredb.store import CommitResult, Database
from ingest.register.control.control_file import read_control_file
from ingest.register.control.maps import GcpRegistration, Survey, place_unplaced_by_gcp, register_by_gcp
from ingest.register.control.placement import GcpOptions
from ingest.register.control.report import residual_table, write_control_report


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControlledMap:
    """What control points did to a map.

    Attributes:
        result: the placement, with its figures; refused where it has no map.
        committed: None where it was refused, or nothing was to be committed.
    """

    map_id: str
    result: GcpRegistration
    committed: CommitResult | None

    def as_text(self) -> str:
        """For the terminal."""
        placement, committed = self.result.placement, self.committed
        lines = [f"note: {note}" for note in placement.control.file.notes]
        lines.append(residual_table(placement).rstrip("\n"))
        if self.result.feature_map is None:
            return "\n".join([*lines, f"refused: {placement.reason}: {placement.message}"]) + "\n"
        lines.append(_moved_words(self.result))
        if committed is None:
            return "\n".join([*lines, "nothing was committed, as asked"]) + "\n"
        word = "committed" if committed.created else "was placed so already"
        lines.append(f"map {self.map_id}: {word}, snapshot {committed.version}")
        lines += [
            f"warning: map {other} was placed by this one and is quarantined now"
            for other in committed.flagged
        ]
        return "\n".join(lines) + "\n"


def place_by_control(
    database: Database,
    map_id: str,
    gcp: Path,
    *,
    crs: str | None = None,
    options: GcpOptions | None = None,
    height_datum: str = "unknown",
    report: Path | None = None,
    dry_run: bool = False,
) -> ControlledMap:
    """Place a map, one without a place, too, and commit it unless it is refused.

    Args:
        map_id: or its first letters, if no other map begins so.
        gcp: control points, OpenDroneMap's gcp_list.txt. crs: instead of the file's first line.
        height_datum: of the surveyed heights, where their reference system does not say it.
        report: folder for control.html and .json.

    Raises:
        ControlFileError, MapNotFoundError, InvalidValueError, StoreError, ConflictError
    """
    survey = Survey(file=read_control_file(gcp, crs), options=options or GcpOptions())
    snapshot = database.snapshot()
    summary = snapshot.find(map_id)
    map_id = summary.map_id
    before = snapshot.load_any(map_id)
    if isinstance(before, UnplacedMap):
        result = place_unplaced_by_gcp(before, survey, height_datum)
    else:
        result = register_by_gcp(before, survey, height_datum)
    if report is not None:
        write_control_report(report, f"Control points of {before.name}", result.placement)
    committed = None
    if result.feature_map is not None and not dry_run:
        committed = database.commit_map(result.feature_map, replaces=map_id, based_on=summary.write_id)
    return ControlledMap(map_id=map_id, result=result, committed=committed)


def _moved_words(result: GcpRegistration) -> str:
    if result.moved_m is None:
        return "the map had no place before"
    east, north, up = result.moved_m
    return f"the map moves by {east:+.2f} m east, {north:+.2f} m north, {up:+.2f} m up"
