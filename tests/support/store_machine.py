"""A database goes through what people and failures do to it, and is always what a plain model says.

The model is a dict of maps to their status and content. Every change may be killed at one of its writes, or,
in an object store, meet one that fails: the database is then as before or as after it.
"""

import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar
from unittest import mock

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from hypothesis.stateful import run_state_machine_as_test as run_machine

from featuredb.errors import ConflictError, StoreError
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.unplaced_map import AnyMap
from featuredb.store import Database
from featuredb.store.commits import oldest_kept_version
from featuredb.store.delta import Table
from featuredb.store.durable import publish
from featuredb.store.durable.backup import backup, restore
from featuredb.store.durable.copies import CopyList, CopyPlace
from featuredb.store.encode import content_digest
from featuredb.store.maintenance import VacuumOptions, compact, vacuum
from featuredb.store.tables import MAPS
from featuredb.store.verify import verify
from tests.support.maps import random_map, without_place
from tests.support.s3_faults import KINDS, RETRIED, SLOW, Fault, FaultyStore
from tests.support.s3_server import BUCKET

State = dict[str, tuple[str, str]]  # status and digest of the content, by map

NOTHING_KEPT = VacuumOptions(history_h=0, orphan_grace_h=0, file_grace_h=0)
SEEDS = st.integers(0, 5)
CUTS = st.one_of(st.none(), st.integers(0, 50))  # a commit makes about 40 calls; None: no kill
DATA = st.data()
# What a rule draws depends on nothing that an object store's timing decides: hypothesis replays draws.
PICKS = st.integers(0, 999)
VERIFY_EVERY = 3  # steps; it costs as much as a commit


def _faults(kind: str) -> st.SearchStrategy[Fault]:
    """One request, which the client's own retries hide; one and its retries; all of an operation."""
    some = st.sampled_from([1, RETRIED, *([] if kind in SLOW else [1000])])
    return st.builds(Fault, kind=st.just(kind), first=st.integers(0, 40), count=some, writes=st.booleans())


FAULTS = st.one_of(st.none(), st.sampled_from(KINDS).flatmap(_faults))


class KilledError(BaseException):
    """The process is dead: nothing that it would do in `except` or `finally` is done."""


@contextmanager
def killed_at(call: int | None) -> Iterator[list[int]]:
    """Die at a call of what writes, of no other name than Python's; the list is not empty where that was."""
    left, deaths = call, list[int]()

    def dying(real: Callable[..., Any]) -> Callable[..., Any]:
        def or_die(*args: Any, **kwargs: Any) -> Any:
            nonlocal left
            if left is not None:
                left -= 1
                if left < 0:
                    deaths.append(1)
                    raise KilledError
            return real(*args, **kwargs)

        return or_die

    with ExitStack() as patches:
        for name in ("fsync", "link", "replace", "unlink", "mkdir"):
            patches.enter_context(mock.patch.object(os, name, dying(getattr(os, name))))
        patches.enter_context(mock.patch.object(publish.shutil, "rmtree", dying(shutil.rmtree)))
        with suppress(KilledError):
            yield deaths


def small_map(map_id: str, seed: int) -> FeatureMap:
    made = random_map(seed, map_id=map_id, points=8, images=2, observations=16, extent_m=10.0)
    return made if seed % 2 else replace(made, status="quarantined")


def seen(database: Database) -> State:
    snapshot = database.snapshot()
    rows = snapshot.rows()
    found = {r["map_id"]: (r["status"], content_digest(snapshot.load_any(r["map_id"]))) for r in rows}
    assert len(found) == len(rows)
    return found


class StoreMachine(RuleBasedStateMachine):
    """A database on this machine's disk. `kills`: operations that were cut off."""

    options: dict[str, str] | None = None
    steps = 0
    kills = 0

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="states"))
        self.count = 0
        self.database = Database.create(self._new_place(), storage_options=self.options)
        self.model: State = {}
        self.past: dict[int, State] = {0: {}}
        self._new_target()

    def teardown(self) -> None:
        assert verify(self.database).problems == ()
        shutil.rmtree(self.folder)

    @initialize()
    def begin(self) -> None:
        self.database.commit_map(small_map("map-1", 1))
        self._take(seen(self.database))
        assert self.model.keys() == {"map-1"}

    @rule(data=DATA, seed=SEEDS)
    def commit(self, data: st.DataObject, seed: int) -> None:
        new = small_map(f"map-{seed}", seed)
        there = self.model.get(new.map_id, ("retired", ""))[0] != "retired"
        self._change(data, lambda: self.database.commit_map(new), {} if there else self._as(new))

    @rule(data=DATA, seed=SEEDS)
    def commit_without_place(self, data: st.DataObject, seed: int) -> None:
        new = without_place(small_map(f"lost-{seed}", seed))
        there = self.model.get(new.map_id, ("retired", ""))[0] != "retired"
        self._change(data, lambda: self.database.commit_map(new), {} if there else self._as(new))

    @rule(data=DATA, pick=PICKS, seed=st.integers(10, 13))
    def place(self, data: st.DataObject, pick: int, seed: int) -> None:
        """Give a map a place, or another one."""
        map_id = self._picked(pick, "unplaced", "active", "quarantined")
        if map_id is None:
            return self._do_nothing(data)
        new = small_map(map_id, seed)
        same = self.model[map_id][1] == content_digest(new)
        after = {} if same else self._as(new)
        return self._change(data, lambda: self.database.commit_map(new, replaces=map_id), after)

    @rule(data=DATA, pick=PICKS)
    def retire(self, data: st.DataObject, pick: int) -> None:
        map_id = self._picked(pick, "unplaced", "active", "quarantined", "retired")
        if map_id is None:
            return self._do_nothing(data)
        after = {map_id: ("retired", self.model[map_id][1])}
        return self._change(data, lambda: self.database.retire(map_id, "wrong"), after)

    @rule(data=DATA, pick=PICKS, status=st.sampled_from(["active", "quarantined"]))
    def promote(self, data: st.DataObject, pick: int, status: Any) -> None:
        map_id = self._picked(pick, "active", "quarantined")
        if map_id is None:
            return self._do_nothing(data)
        after = {map_id: (status, self.model[map_id][1])}
        return self._change(data, lambda: self.database.set_status([map_id], status, "seen"), after)

    @rule(data=DATA, pick=PICKS)
    def rollback(self, data: st.DataObject, pick: int) -> None:
        first = oldest_kept_version(self.database.table(MAPS).commits())
        kept = [v for v in sorted(self.past) if v >= first]
        version = kept[pick % len(kept)]
        self._change(data, lambda: self.database.rollback(version), self.past[version], whole=True)

    @rule(data=DATA)
    def compact(self, data: st.DataObject) -> None:
        self._change(data, lambda: compact(self.database), {})

    @rule(data=DATA, options=st.sampled_from([NOTHING_KEPT, VacuumOptions()]))
    def vacuum(self, data: st.DataObject, options: VacuumOptions) -> None:
        self._change(data, lambda: vacuum(self.database, options), {})

    @rule(data=DATA)
    def backup(self, data: st.DataObject) -> None:
        with self._disturbed(data) as killed:
            self._back_up()
        if not killed:
            self.kept = (self.model, dict(self.past))
            return
        if self.kept is None and not self._has_backup():
            with pytest.raises(StoreError, match=r"no backup at|never finished"):
                self._restored()
        else:
            before = [self.kept[0]] if self.kept is not None else []
            assert seen(self._restored()) in (self.model, *before)
        self._back_up()
        self.kept = (self.model, dict(self.past))

    @rule(data=DATA)
    def restore(self, data: st.DataObject) -> None:
        """The database is lost, and comes back from its backup."""
        if self.kept is None:
            return self._do_nothing(data)
        place = self._new_place()
        with self._disturbed(data) as killed:
            self._restore(place)
        if killed and (self._copied(place) or not Table.exists(f"{place}/{MAPS}", self.options)):  # not done
            self._restore(place)
        self._lose(self.database.url)
        self.database = Database.open(place, storage_options=self.options)
        self.model, self.past = self.kept
        return self._new_target()

    @invariant()
    def is_what_the_model_says(self) -> None:
        type(self).steps += 1
        assert seen(self.database) == self.model
        if type(self).steps % VERIFY_EVERY == 0:
            assert verify(self.database).problems == ()

    def _change(
        self, data: st.DataObject, operation: Callable[[], object], change: State, *, whole: bool = False
    ) -> None:
        """Do what changes maps to a state, all of them with `whole`, or nothing where it is killed."""
        after = change if whole else self.model | change
        with self._disturbed(data) as killed:
            operation()
        found = seen(self.database)
        assert found == after or (killed and found == self.model)
        self._take(found)

    def _take(self, found: State) -> None:
        self.model = found
        for version in range(max(self.past) + 1, self.database.poll_version() + 1):
            self.past[version] = found

    def _do_nothing(self, data: st.DataObject) -> None:
        self._change(data, lambda: None, {})

    def _picked(self, pick: int, *statuses: str) -> str | None:
        """One of the maps of these statuses."""
        maps = sorted(map_id for map_id, (status, _) in self.model.items() if status in statuses)
        return maps[pick % len(maps)] if maps else None

    @staticmethod
    def _as(new: AnyMap) -> State:
        return {new.map_id: (new.status, content_digest(new))}

    def _new_place(self) -> str:
        self.count += 1
        return str(self.folder / f"{self.count}.db")

    def _new_target(self) -> None:
        self.target, self.kept = self._new_place(), None  # type: tuple[State, dict[int, State]] | None

    def _lose(self, url: str) -> None:
        shutil.rmtree(url)

    @contextmanager
    def _disturbed(self, data: st.DataObject) -> Iterator[list[int]]:
        """An operation that may be cut off; the list is not empty where it was."""
        with killed_at(data.draw(CUTS, "killed at")) as killed:
            yield killed
        type(self).kills += bool(killed)

    def _back_up(self) -> None:
        backup(self.database, self.target, self.options)

    def _restore(self, url: str) -> None:
        restore(self.target, Database(url, self.options), self.options)

    def _copied(self, url: str) -> CopyList | None:
        return CopyPlace(url, self.options).read_list()

    def _has_backup(self) -> bool:
        found = self._copied(self.target)
        return found is not None and bool(found.files)

    def _restored(self) -> Database:
        place = self._new_place()
        self._restore(place)
        return Database.open(place, storage_options=self.options)


class ObjectStoreMachine(StoreMachine):
    """A database in an object store that fails. `faults`: requests that did."""

    store: FaultyStore
    faults: ClassVar[Counter[str]] = Counter()

    def __init__(self) -> None:
        self.options = self.store.options
        super().__init__()

    @rule(data=DATA)
    def read(self, data: st.DataObject) -> None:
        with self._disturbed(data):
            self.database.poll_version()
            assert seen(Database.open(self.database.url, storage_options=self.options)) == self.model
            self.database.history()

    @rule(data=DATA)
    def verify(self, data: st.DataObject) -> None:
        """What does not answer is not taken for damage."""
        with self._disturbed(data):
            assert verify(self.database).problems == ()

    @contextmanager
    def _disturbed(self, data: st.DataObject) -> Iterator[list[int]]:
        fault, ended = data.draw(FAULTS, "fault"), list[int]()
        try:
            with self.store.failing(fault):
                yield ended
        except (StoreError, ConflictError) as error:
            # Nothing is said to be lost or never to have been there.
            if not self.store.injected or type(error) not in (StoreError, ConflictError):
                raise
            ended.append(1)
        finally:
            if fault is not None:
                self.faults[fault.kind] += self.store.injected
        type(self).kills += bool(ended)

    def _new_place(self) -> str:
        self.count += 1
        return f"s3://{BUCKET}/{self.folder.name}/{self.count}.db"

    def _lose(self, url: str) -> None:
        """It stays where it is, and nobody looks."""


def run(machine: type[StoreMachine], examples: int, steps: int) -> None:
    machine.steps = machine.kills = 0
    run_machine(
        machine,
        settings=settings(
            max_examples=examples,
            stateful_step_count=steps,
            deadline=None,
            derandomize=True,
            database=None,
            suppress_health_check=list(HealthCheck),
        ),
    )
