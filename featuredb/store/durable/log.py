"""A table's log as files: which entries there are, whether each is whole, which one was acknowledged last.

An entry says in its first line how many files it adds and removes, so that one that was cut off between two
lines is found, too. A commit that is done leaves its version as the name of an empty file in `_acknowledged`
and removes the names below it; the highest name there is the last acknowledged version. Names are only ever
made, and those below one's own removed: concurrent writers need no lock, object stores no conditional write.
"""

import hashlib
import json
import logging
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any
from urllib.parse import unquote

import pyarrow as pa
import pyarrow.fs as fs
import pyarrow.parquet as pq

from featuredb.errors import StoreError

logger = logging.getLogger(__name__)

LOG, ACKNOWLEDGED, LAST_CHECKPOINT = "_delta_log", "_acknowledged", "_last_checkpoint"
# Keys of what a commit says about itself.
OPERATION, CHANGED, REASON = "featuredb.operation", "featuredb.maps", "featuredb.reason"
# Tag of an added file: of its bytes. In the line commitInfo of an entry: of its actions without this.
DIGEST = "featuredb.sha256"
_ENTRY = re.compile(r"(\d{20})\.json")
_CHECKPOINT = re.compile(r"(\d{20})\.checkpoint.*\.parquet")
_NAME = re.compile(r"(\d{20})")
_ADDED, _REMOVED = ("num_added_files", "numFilesAdded"), ("num_removed_files", "numFilesRemoved")

Action = dict[str, Any]


@dataclass(frozen=True, slots=True)
class LogProblem:
    """What is wrong with a file of a log: its name, what, the version if it is an entry (no checkpoint)."""

    name: str
    what: str
    version: int | None = None


def entry_name(version: int) -> str:
    """File name of a log entry."""
    return f"{version:020d}.json"


def read_actions(content: bytes) -> list[Action]:
    """The actions of a log entry.

    Raises:
        ValueError: it is empty or torn; the message says how.
    """
    if not content.strip():
        raise ValueError(f"it is empty ({len(content)} bytes)")
    try:
        actions = [json.loads(line) for line in content.splitlines() if line.strip()]
    except ValueError as error:
        raise ValueError(f"it is torn or broken ({len(content)} bytes: {error})") from error
    if not all(isinstance(action, dict) for action in actions):
        raise ValueError("it has lines that are no actions")
    info = next((action["commitInfo"] for action in actions if "commitInfo" in action), None)
    if not isinstance(info, dict):
        raise ValueError("its line commitInfo is missing")
    if not isinstance(info.get("timestamp"), int):
        raise ValueError("its line commitInfo has no timestamp")
    if info.get("operation") == "CREATE TABLE" and not any("metaData" in action for action in actions):
        raise ValueError("it is torn: its line metaData is missing")
    metrics = info.get("operationMetrics")
    metrics = metrics if isinstance(metrics, dict) else {}
    for kind, names in (("add", _ADDED), ("remove", _REMOVED)):
        expected = next((metrics[n] for n in names if n in metrics), None)
        lines = [action[kind] for action in actions if kind in action]
        if not all(isinstance(line, dict) and isinstance(line.get("path"), str) for line in lines):
            raise ValueError(f"it has lines {kind!r} that name no file")
        found = len(lines)
        if expected is not None and found != expected:
            raise ValueError(f"it is torn: expected {expected} lines {kind!r}, found {found}")
    if info.get(DIGEST, digest := actions_digest(actions)) != digest:
        raise ValueError("its bytes are not those that were written: hashes differ")
    return actions


def actions_digest(actions: Iterable[Action]) -> str:
    """SHA-256 of the actions of an entry, in hex digits, which the entry itself may say."""
    lines = [
        {"commitInfo": {k: v for k, v in action["commitInfo"].items() if k != DIGEST}}
        if "commitInfo" in action
        else action
        for action in actions
    ]
    return hashlib.sha256(json.dumps(lines, sort_keys=True).encode()).hexdigest()


def paths_of(kind: str, actions: Iterable[Action]) -> list[str]:
    """The files that actions of a kind, "add" or "remove", name."""
    return [unquote(action[kind]["path"]) for action in actions if kind in action]


def named_checkpoint(content: bytes) -> int | None:
    """The version that the file `_last_checkpoint` names; None where it is empty or torn."""
    try:
        return int(json.loads(content)["version"])
    except (ValueError, KeyError, TypeError):
        return None


def list_entries(files: fs.FileSystem) -> dict[int, datetime]:
    """The versions of which there is a log entry, in order, and when the store got each, UTC."""
    return dict(sorted(_numbered(files, LOG, _ENTRY)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Commit:
    """One entry of a table's log, timestamp in UTC, and what featuredb says with it."""

    version: int
    timestamp: datetime
    metadata: dict[str, str]

    @property
    def operation(self) -> str:
        """Commit, retire, ..."""
        return self.metadata.get(OPERATION, "" if self.version else "init")

    @property
    def maps(self) -> tuple[str, ...]:
        """Ids of the maps or scans that it is about."""
        return tuple(filter(None, self.metadata.get(CHANGED, "").split("\n")))

    @property
    def reason(self) -> str:
        return self.metadata.get(REASON, "")


def read_commit(files: fs.FileSystem, version: int) -> Commit:
    """What a log entry says of itself.

    Raises:
        StoreError: it is missing, empty or torn, or does not say when it was made.
    """
    info = next(a["commitInfo"] for a in whole_entry(files, version)[1] if "commitInfo" in a)
    return Commit(
        version=version,
        timestamp=datetime.fromtimestamp(info["timestamp"] / 1000.0, tz=UTC),
        metadata={k: str(v) for k, v in info.items() if k.startswith("featuredb.")},
    )


def whole_entry(files: fs.FileSystem, version: int) -> tuple[bytes, list[Action]]:
    """A table's log entry as it is written, and its actions.

    Raises:
        StoreError: it is missing, empty or torn.
    """
    try:
        return _entry(files, version)
    except ValueError as error:
        raise StoreError(f"log entry {entry_name(version)}: {error}; run `featuredb verify`") from error


def _entry(files: fs.FileSystem, version: int) -> tuple[bytes, list[Action]]:
    try:
        content = _read(files, f"{LOG}/{entry_name(version)}")
    except FileNotFoundError:
        raise ValueError("it is missing") from None
    return content, read_actions(content)


def file_digests(files: fs.FileSystem) -> dict[str, str]:
    """The SHA-256 of each file that a log has ever named, by path; not of files of older releases.

    Raises:
        StoreError: an entry is missing, empty or torn.
    """
    adds = (a["add"] for v in list_entries(files) for a in whole_entry(files, v)[1] if "add" in a)
    return {unquote(add["path"]): add["tags"][DIGEST] for add in adds if DIGEST in (add.get("tags") or {})}


def acknowledged(files: fs.FileSystem) -> int:
    """The last version of which a writer was told that it is done; -1 in tables of older releases."""
    return max((version for version, _ in _numbered(files, ACKNOWLEDGED, _NAME)), default=-1)


def acknowledge(files: fs.FileSystem, version: int) -> None:
    """Note that a version is committed, as well as the store allows.

    It is not waited for: where this is lost, only what `verify` would have compared with is lost.
    """
    place = f"{ACKNOWLEDGED}/{version:020d}"
    try:
        try:
            files.open_output_stream(place).close()
        except FileNotFoundError:  # the first of this table; object stores have no folders
            files.create_dir(ACKNOWLEDGED)
            files.open_output_stream(place).close()
        for older, _ in _numbered(files, ACKNOWLEDGED, _NAME):
            if older < version:
                files.delete_file(f"{ACKNOWLEDGED}/{older:020d}")
    except FileNotFoundError:  # another writer was faster
        return
    except OSError as error:
        logger.warning("cannot note version %d as committed: %s", version, error)


def forget_acknowledged(files: fs.FileSystem, version: int) -> None:
    """Make a version the last acknowledged one, where later ones are lost."""
    for later, _ in _numbered(files, ACKNOWLEDGED, _NAME):
        if later > version:
            files.delete_file(f"{ACKNOWLEDGED}/{later:020d}")
    acknowledge(files, version)


def check_end(url: str, files: fs.FileSystem, version: int) -> None:
    """Is the log whole where a reader takes it for its end?

    Not asked of object stores, which tear and lose no files: `verify` asks there what this would at each
    poll.

    Raises:
        StoreError: its last entry is empty or torn, or an acknowledged one is missing.
    """
    if "://" in url:
        return
    head = acknowledged(files)
    for end in ([head] if head > version else []) + [version]:
        try:
            _entry(files, end)
        except ValueError as error:
            late = ", though it was acknowledged" if end > version else ""
            raise damaged(url, LogProblem(entry_name(end), f"{error}{late}", end)) from error


def damaged(url: str, problem: LogProblem) -> StoreError:
    """The error for a log that cannot be used, in words."""
    return StoreError(
        f"cannot open {url}: {LOG}/{problem.name}: {problem.what}; `featuredb repair` says what can be done"
    )


def log_problems(files: fs.FileSystem) -> Iterator[LogProblem]:
    """What is wrong with a table's log; reads every entry once."""
    # What was written last is read first: others may commit meanwhile.
    try:
        pointer = _read(files, f"{LOG}/{LAST_CHECKPOINT}")
    except FileNotFoundError:
        pointer = None
    checkpoints = _checkpoints(files)
    head, newest = acknowledged(files), max(list_entries(files), default=-1)
    columns: Action = {}
    live: dict[str, Action] = {}
    whole, of_checkpoints = True, list[LogProblem]()
    for version in range(max(newest, head) + 1):
        try:
            actions = _entry(files, version)[1]
        except ValueError as error:
            whole = False
            late = f", though version {head} was acknowledged" if version > newest else ""
            yield LogProblem(entry_name(version), f"{error}{late}", version)
        else:
            columns = next((a["metaData"] for a in actions if "metaData" in a), columns)
            for path in (a["remove"]["path"] for a in actions if "remove" in a):
                live.pop(path, None)
            live |= {a["add"]["path"]: a["add"] for a in actions if "add" in a}
        for name in checkpoints.get(version, ()) if version <= newest else ():
            what = _checkpoint_problem(files, name, columns, live.values(), whole=whole)
            of_checkpoints += [LogProblem(name, what)] if what else []
    yield from of_checkpoints
    for version, names in checkpoints.items():
        if version > newest:
            yield from (LogProblem(n, f"it is of version {version}, which has no entry") for n in names)
    if pointer is None:
        return
    if (named := named_checkpoint(pointer)) is None:
        yield LogProblem(LAST_CHECKPOINT, "it is empty or torn")
    elif named > newest or named not in checkpoints:
        yield LogProblem(LAST_CHECKPOINT, f"it names checkpoint {named}, which is not there")


def _checkpoints(files: fs.FileSystem) -> dict[int, list[str]]:
    """Names of the files of checkpoints, by version."""
    found: dict[int, list[str]] = {}
    for info in files.get_file_info(fs.FileSelector(LOG, allow_not_found=True)):
        if match := _CHECKPOINT.fullmatch(info.base_name):
            found.setdefault(int(match[1]), []).append(info.base_name)
    return found


def _checkpoint_problem(
    files: fs.FileSystem, name: str, columns: Action, adds: Iterable[Action], *, whole: bool
) -> str | None:
    """What is wrong with a checkpoint: it repeats what the entries say, and a broken one hinders readers.

    Args:
        columns, adds: what the entries say.
        whole: False where entries are damaged: then the checkpoint need only be one that can be read.
    """
    try:
        checkpoint = pq.read_table(f"{LOG}/{name}", filesystem=files)
        (named,) = filter(None, checkpoint["metaData"].to_pylist())
        said = _state(named, filter(None, checkpoint["add"].to_pylist()))
        same = not whole or said == _state(columns, adds)
        return None if same else "it says something else than the entries"
    except (OSError, pa.ArrowException, KeyError, ValueError, TypeError) as error:
        return f"it cannot be read: {' '.join(str(error).split())[:200]}"


def _state(columns: Action, adds: Iterable[Action]) -> dict[str, Any]:
    """What readers go by, in one form: a checkpoint has lists of pairs where an entry has objects."""
    state = {"": [columns[name] for name in ("description", "schemaString", "partitionColumns")]}
    for add in adds:
        stats = json.loads(add["stats"]) if add.get("stats") else None
        state[add["path"]] = [dict(add["partitionValues"]), add["size"], stats, dict(add.get("tags") or {})]
    return state


def _numbered(files: fs.FileSystem, folder: str, name: re.Pattern[str]) -> Iterator[tuple[int, datetime]]:
    """Numbers in the names of a folder's files, and the time of each."""
    for info in files.get_file_info(fs.FileSelector(folder, allow_not_found=True)):
        if match := name.fullmatch(info.base_name):
            yield int(match[1]), utc(info.mtime)


def utc(time: datetime) -> datetime:
    """A file's time with its zone."""
    return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)


def _read(files: fs.FileSystem, path: str) -> bytes:
    with files.open_input_file(path) as stream:
        content: bytes = stream.read()
    return content
