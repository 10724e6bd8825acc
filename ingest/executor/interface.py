"""What every executor does, and the simplest one."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

_LOG = logging.getLogger(__name__)

Item = TypeVar("Item")
Result = TypeVar("Result")
Progress = Callable[[str, int, int], None]
"""Called as progress(stage, done, total) from the calling thread."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Lost:
    """Stands in the place of a result: the task ended the worker that ran it, again and again.

    Attributes:
        task: the task's name, `str(item)`.
        reason: for people, how the workers ended and what helps.
    """

    task: str
    reason: str


def given_up(stage: str, item: object, ended: str) -> Lost:
    """A task that ended every worker that ran it, which and how many `ended` says."""
    _LOG.warning("%s: %s ends every worker that runs it", stage, item)
    return Lost(task=str(item), reason=f"{ended} (killed, or out of memory); the same command tries it again")


def no_progress(stage: str, done: int, total: int) -> None:
    """Progress that nobody watches."""


class Executor(Protocol):
    """Runs a function over items. Every executor gives the same results in the items' order.

    Functions must be importable by name (no lambdas), items and results small: large things travel as files
    of the work folder.
    """

    def map(
        self,
        stage: str,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        progress: Progress = no_progress,
    ) -> list[Result | Lost]:
        """Run `function` over `items`.

        A worker that dies costs the tasks that it had: they run again. A task whose workers die every
        time is `Lost`; the others go on.

        Raises:
            IngestError: no worker can be started, or reached any more.
            Exception: whatever the function raised.
        """
        ...


class InProcessExecutor:
    """Runs everything in the calling thread: for tests and for debuggers. Nothing is ever lost."""

    def map(
        self,
        stage: str,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        progress: Progress = no_progress,
    ) -> list[Result | Lost]:
        results: list[Result | Lost] = []
        for item in items:
            results.append(function(item))
            progress(stage, len(results), len(items))
        return results
