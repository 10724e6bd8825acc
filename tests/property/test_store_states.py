"""A database goes through what people and failures do to it, and is always what a plain model says.

The model is a dict of maps to their status and content. Every change may be killed at one of its writes: the
database is then as before or as after it.
"""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from hypothesis.stateful import run_state_machine_as_test as run_machine

from featuredb.errors import StoreError
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.unplaced_map import AnyMap
from featuredb.store import Database
from featuredb.store.commits import oldest_kept_version
from featuredb.store.durable import publish
from featuredb.store.durable.backup import backup, restore
from featuredb.store.durable.copies import LIST, CopyPlace
from featuredb.store.encode import content_digest
from featuredb.store.maintenance import VacuumOptions, compact, vacuum
from featuredb.store.tables import MAPS
from featuredb.store.verify import verify
from tests.support.maps import random_map, without_place

State = dict[str, tuple[str, str]]  # status and digest of the content, by map

NOTHING_KEPT = VacuumOptions(history_h=0, orphan_grace_h=0, file_grace_h=0)
SEEDS = st.integers(0, 5)
CUTS = st.one_of(st.none(), st.integers(0, 50))  # a commit makes about 40 calls; None: no kill
VERIFY_EVERY = 3  # steps; it costs as much as a commit


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
    return {
        r["map_id"]: (r["status"], content_digest(snapshot.load_any(r["map_id"]))) for r in snapshot.rows()
    }


class StoreMachine(RuleBasedStateMachine):
    steps = 0
    kills = 0

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="states"))
        self.count = 0
        self.database = Database.create(self._new_place())
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

    @rule(seed=SEEDS, cut=CUTS)
    def commit(self, seed: int, cut: int | None) -> None:
        new = small_map(f"map-{seed}", seed)
        there = self.model.get(new.map_id, ("retired", ""))[0] != "retired"
        self._change(lambda: self.database.commit_map(new), {} if there else self._as(new), cut)

    @rule(seed=SEEDS, cut=CUTS)
    def commit_without_place(self, seed: int, cut: int | None) -> None:
        new = without_place(small_map(f"lost-{seed}", seed))
        there = self.model.get(new.map_id, ("retired", ""))[0] != "retired"
        self._change(lambda: self.database.commit_map(new), {} if there else self._as(new), cut)

    @precondition(lambda self: self._of("unplaced", "active", "quarantined"))
    @rule(data=st.data(), seed=st.integers(10, 13), cut=CUTS)
    def place(self, data: st.DataObject, seed: int, cut: int | None) -> None:
        """Give a map a place, or another one."""
        map_id = data.draw(st.sampled_from(self._of("unplaced", "active", "quarantined")))
        new = small_map(map_id, seed)
        same = self.model[map_id][1] == content_digest(new)
        after = {} if same else self._as(new)
        self._change(lambda: self.database.commit_map(new, replaces=map_id), after, cut)

    @precondition(lambda self: self.model)
    @rule(data=st.data(), cut=CUTS)
    def retire(self, data: st.DataObject, cut: int | None) -> None:
        map_id = data.draw(st.sampled_from(sorted(self.model)))
        after = {map_id: ("retired", self.model[map_id][1])}
        self._change(lambda: self.database.retire(map_id, "wrong"), after, cut)

    @precondition(lambda self: self._of("active", "quarantined"))
    @rule(data=st.data(), status=st.sampled_from(["active", "quarantined"]), cut=CUTS)
    def promote(self, data: st.DataObject, status: Any, cut: int | None) -> None:
        map_id = data.draw(st.sampled_from(self._of("active", "quarantined")))
        after = {map_id: (status, self.model[map_id][1])}
        self._change(lambda: self.database.set_status([map_id], status, "seen"), after, cut)

    @rule(data=st.data(), cut=CUTS)
    def rollback(self, data: st.DataObject, cut: int | None) -> None:
        first = oldest_kept_version(self.database.table(MAPS).commits())
        version = data.draw(st.sampled_from([v for v in sorted(self.past) if v >= first]))
        self._change(lambda: self.database.rollback(version), self.past[version], cut, whole=True)

    @rule(cut=CUTS)
    def compact(self, cut: int | None) -> None:
        self._change(lambda: compact(self.database), {}, cut)

    @rule(cut=CUTS, options=st.sampled_from([NOTHING_KEPT, VacuumOptions()]))
    def vacuum(self, cut: int | None, options: VacuumOptions) -> None:
        self._change(lambda: vacuum(self.database, options), {}, cut)

    @rule(cut=CUTS)
    def backup(self, cut: int | None) -> None:
        with killed_at(cut) as killed:
            backup(self.database, self.target)
        if not killed:
            self.kept = (self.model, dict(self.past))
            return
        StoreMachine.kills += 1
        if self.kept is None and not self._has_backup():
            with pytest.raises(StoreError, match=r"no backup at|never finished"):
                self._restored()
        else:
            before = [self.kept[0]] if self.kept is not None else []
            assert seen(self._restored()) in (self.model, *before)
        backup(self.database, self.target)
        self.kept = (self.model, dict(self.past))

    @precondition(lambda self: self.kept is not None)
    @rule(cut=CUTS)
    def restore(self, cut: int | None) -> None:
        """The database is lost, and comes back from its backup."""
        place = Database(self._new_place())
        with killed_at(cut) as killed:
            restore(self.target, place)
        if killed:
            StoreMachine.kills += 1
            if (Path(place.url) / LIST).exists() or not (Path(place.url) / MAPS).exists():  # not done
                restore(self.target, place)
        shutil.rmtree(self.database.url)
        self.database = Database.open(place.url)
        assert self.kept is not None
        self.model, self.past = self.kept
        self._new_target()

    @invariant()
    def is_what_the_model_says(self) -> None:
        StoreMachine.steps += 1
        assert seen(self.database) == self.model
        if StoreMachine.steps % VERIFY_EVERY == 0:
            assert verify(self.database).problems == ()

    def _change(
        self, operation: Callable[[], object], change: State, cut: int | None, *, whole: bool = False
    ) -> None:
        """Do what changes maps to a state, all of them with `whole`, or nothing where it is killed."""
        after = change if whole else self.model | change
        with killed_at(cut) as killed:
            operation()
        found = seen(self.database)
        StoreMachine.kills += bool(killed)
        assert found == after or (killed and found == self.model)
        self._take(found)

    def _take(self, found: State) -> None:
        self.model = found
        for version in range(max(self.past) + 1, self.database.poll_version() + 1):
            self.past[version] = found

    def _of(self, *statuses: str) -> list[str]:
        return sorted(map_id for map_id, (status, _) in self.model.items() if status in statuses)

    @staticmethod
    def _as(new: AnyMap) -> State:
        return {new.map_id: (new.status, content_digest(new))}

    def _new_place(self) -> str:
        self.count += 1
        return str(self.folder / f"{self.count}.db")

    def _new_target(self) -> None:
        self.target, self.kept = self._new_place(), None  # type: tuple[State, dict[int, State]] | None

    def _has_backup(self) -> bool:
        found = CopyPlace(self.target, None).read_list()
        return found is not None and bool(found.files)

    def _restored(self) -> Database:
        place = self._new_place()
        restore(self.target, Database(place))
        return Database.open(place)


def run(examples: int, steps: int) -> None:
    StoreMachine.steps = StoreMachine.kills = 0
    run_machine(
        StoreMachine,
        settings=settings(
            max_examples=examples,
            stateful_step_count=steps,
            deadline=None,
            derandomize=True,
            database=None,
            suppress_health_check=list(HealthCheck),
        ),
    )


def test_some_steps() -> None:
    run(6, 12)
    assert StoreMachine.kills > 0


@pytest.mark.evaluation
@pytest.mark.timeout(7200)
def test_two_thousand_steps() -> None:
    run(95, 26)
    assert StoreMachine.steps >= 2000
    assert StoreMachine.kills > 200
