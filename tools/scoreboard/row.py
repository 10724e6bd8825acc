"""A row of the scoreboard: a claim, the command that measures it, and what its figures must be."""

import string
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from featuredb.errors import InvalidValueError

Group = Literal["real", "simulated", "speed"]
Form = Literal["quick", "full"]
Figures = Mapping[str, float | int | str | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Limit:
    """What a figure must be: `least` at the least, `most` at the most."""

    figure: str
    least: float | None = None
    most: float | None = None

    def __post_init__(self) -> None:
        if self.least is None and self.most is None:
            raise InvalidValueError(f"limit of {self.figure}: expected least, most or both, found neither")

    def holds(self, figures: Figures) -> bool:
        """Whether the figure is there and within the limit."""
        value = figures.get(self.figure)
        if value is None or isinstance(value, str):
            return False
        return (self.least is None or value >= self.least) and (self.most is None or value <= self.most)

    def __str__(self) -> str:
        if self.least == self.most:
            return f"{self.figure} = {self.least:g}"
        low = "" if self.least is None else f"{self.least:g} <= "
        return f"{low}{self.figure}{'' if self.most is None else f' <= {self.most:g}'}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A claim.

    Attributes:
        name: by which it is asked for. group: table in which it stands. form: with which it runs.
        claim: what is claimed, for readers.
        commands: argument vectors, run one after the other by this Python; `{data}` is the folder of real
            sets, `{work}` an empty folder of the row, `{cache}` one that rows and commits share, for inputs
            that do not depend on the program. The first word is a module (`tools.x`, `featuredb.cli`).
        json: file with the figures, which the last command writes.
        text: the figures in words, a format string.
        limits: all must hold.
        figures: name -> where it is in the file, keys joined by dots: of those that are kept beside what
            `text` and `limits` name, and of what does not stand there under its own name.
        needs: paths under `{data}`; the row is skipped where one is absent.
        resumes: whether the command goes on with what it finds in `{work}` of the same commit.
        readme: whether README shows it. minutes: about how long it takes on two cores.
    """

    name: str
    group: Group
    form: Form
    claim: str
    commands: tuple[tuple[str, ...], ...]
    text: str
    limits: tuple[Limit, ...]
    figures: Mapping[str, str] = field(default_factory=dict)
    json: str = "{work}/figures.json"
    needs: tuple[str, ...] = ()
    resumes: bool = False
    readme: bool = False
    minutes: float = 1.0

    def __post_init__(self) -> None:
        if not self.limits or not self.commands:
            raise InvalidValueError(f"row {self.name}: expected a command and a limit")

    def read(self, document: Mapping[str, Any]) -> dict[str, float | int | str | None]:
        """The row's figures of what the command has written; None for what is not there."""
        words = (name for _, name, _, _ in string.Formatter().parse(self.text) if name is not None)
        named = {*words, *(limit.figure for limit in self.limits)} - {"seconds"}
        paths = {name: name for name in sorted(named)} | dict(self.figures)
        return {name: _at(document, path) for name, path in paths.items()}

    def holds(self, figures: Figures) -> bool:
        """Whether all limits hold."""
        return all(limit.holds(figures) for limit in self.limits)

    def missed(self, figures: Figures) -> str:
        """The limits that do not hold, each with its figure; "" where all do."""
        found = [(limit, figures.get(limit.figure)) for limit in self.limits if not limit.holds(figures)]
        return ", ".join(
            f"{limit} (it is {value:.3g})" if isinstance(value, float | int) else f"{limit} (not measured)"
            for limit, value in found
        )

    def words(self, figures: Figures) -> str:
        """The figures in words; what is missing shows as a dash."""
        return string.Formatter().vformat(self.text, (), _Dashes(figures))


class _Dash:
    def __format__(self, _: str) -> str:
        return "-"


class _Dashes(dict[str, Any]):
    def __getitem__(self, key: str) -> Any:
        value = super().get(key)
        return _Dash() if value is None else value


def _at(document: Any, path: str) -> float | int | str | None:
    for key in path.split("."):
        if not isinstance(document, Mapping) or key not in document:
            return None
        document = document[key]
    return document if isinstance(document, float | int | str) else None
