"""A database with a damaged log, back to its last whole state; nothing is deleted, nothing old is touched."""

import uuid
from collections.abc import Iterator
from dataclasses import dataclass

import pyarrow.fs as fs

from featuredb.store.database import Database
from featuredb.store.durable.filesystem import store_errors, table_files
from featuredb.store.durable.log import (
    LOG,
    LogProblem,
    acknowledged,
    forget_acknowledged,
    list_entries,
    log_problems,
)
from featuredb.store.tables import MAPS, SPECS

SET_ASIDE = "_set_aside"


@dataclass(frozen=True, slots=True, kw_only=True)
class RepairStep:
    """One damage, and what is done about it.

    Attributes:
        action: what `repair` does (or has done with `apply`); "" where it does nothing.
        advice: what the person can do where it does nothing.
    """

    where: str
    what: str
    action: str
    advice: str = ""


def repair(database: Database, *, apply: bool = False, give_up_lost: bool = False) -> list[RepairStep]:
    """Look for damage of the logs, and set aside newest entries that were never acknowledged.

    Files are moved to `_set_aside` in their table. The database need not be one that can be opened.

    Args:
        give_up_lost: also where the newest entries were acknowledged and are missing or damaged: what they
            said is lost, and the database goes back to the state before them.

    Raises:
        DatabaseNotFoundError: there is no database.
        StoreError: the store failed.
    """
    steps: list[RepairStep] = []
    with store_errors(f"cannot repair {database.url}"):
        for name in SPECS:
            files = table_files(database.table_url(name), database.storage_options)
            if problems := list(log_problems(files)):
                steps += _repair_table(name, files, problems, apply, give_up_lost)
        if not steps:
            database.table(MAPS)
    return steps


def _repair_table(
    name: str, files: fs.FileSystem, problems: list[LogProblem], apply: bool, give_up_lost: bool
) -> Iterator[RepairStep]:
    broken = {p.version: p for p in problems if p.version is not None}
    there, head = list_entries(files), acknowledged(files)
    whole = max((v for v in there if v not in broken), default=-1)  # the state to go back to
    for version, problem in broken.items():
        where = f"{name}/{LOG}/{problem.name}"
        if version < whole or whole < 0:
            advice = "restore the database from a backup: newer states build on this one"
            yield RepairStep(where=where, what=problem.what, action="", advice=advice)
        elif version <= head and not give_up_lost:
            advice = (
                "it was acknowledged: restore the database from a backup, or give up what it said with "
                f"--give-up-lost, which goes back to version {whole} of {name}"
            )
            yield RepairStep(where=where, what=problem.what, action="", advice=advice)
        else:
            action = f"set aside: back to version {whole} of {name}"
            yield _step(files, where, problem, action, apply and version in there)
            if apply and head > whole:
                forget_acknowledged(files, whole)
    if apply and broken:  # a checkpoint of what was set aside must go, too
        problems = list(log_problems(files))
    entries_left = any(p.version is not None for p in problems)
    for problem in problems:
        if problem.version is None:
            where = f"{name}/{LOG}/{problem.name}"
            if entries_left:
                advice = "first repair the entries, and then again"
                yield RepairStep(where=where, what=problem.what, action="", advice=advice)
            else:
                yield _step(files, where, problem, "set aside: the entries say the same", apply)


def _step(files: fs.FileSystem, where: str, problem: LogProblem, action: str, move: bool) -> RepairStep:
    if move:
        files.create_dir(SET_ASIDE)
        files.move(f"{LOG}/{problem.name}", f"{SET_ASIDE}/{problem.name}.{uuid.uuid4().hex[:8]}")
    return RepairStep(where=where, what=problem.what, action=action)
