"""A row of the scoreboard: a claim, the command that measures it, and what its figures must be."""

import math
import re
import shlex
import string
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from featuredb.errors import InvalidValueError

Group = Literal["real", "simulated", "speed"]
Form = Literal["quick", "full"]
Figures = Mapping[str, float | int | str | None]
_LIMIT = re.compile(r"(?:(-?[\d.]+) <= )?([a-z]\w*)(?: (<=|=) (-?[\d.]+))?")


@dataclass(frozen=True, slots=True, kw_only=True)
class Limit:
    """What a figure must be, as `14 <= photos`, `lost <= 0`, `0.63 <= share <= 0.73` or `maps = 1` say it."""

    text: str
    figure: str
    least: float
    most: float

    @classmethod
    def of(cls, text: str) -> "Limit":
        """The limit that a text says. Raises InvalidValueError: it says none."""
        found = _LIMIT.fullmatch(text)
        least, figure, sign, most = found.groups() if found else (None,) * 4
        if figure is None or (least is None and most is None):
            raise InvalidValueError(
                f"limit {text!r}: expected one as `14 <= photos`, `lost <= 0` or `maps = 1`"
            )
        low = most if sign == "=" else least
        return cls(text=text, figure=figure, least=float(low or -math.inf), most=float(most or math.inf))

    def holds(self, figures: Figures) -> bool:
        """Whether the figure is there and within the limit."""
        value = figures.get(self.figure)
        return value is not None and not isinstance(value, str) and self.least <= value <= self.most


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A claim.

    Attributes:
        name: by which it is asked for. group: table in which it stands. form: with which it runs.
        claim: what is claimed, for readers.
        commands: one a line, run one after the other by this Python; `{data}` is the folder of real sets,
            `{work}` an empty folder of the row, whose figures.json the last one writes, `{cache}` one that
            rows and commits share, for inputs that do not depend on the program. The first word is a module
            (`tools.x`, `featuredb.cli`).
        text: the figures in words, a format string.
        limits: all must hold; between commas, each as `Limit` reads it.
        figures: names of those that are kept beside what `text` and `limits` name. What does not stand in the
            file under its own name stands there in a part: `smooth_lost` is `lost` of `smooth`; where there
            is but one part, in that. `times=ratio` is called otherwise there.
        resumes: whether the command goes on with what it finds in `{work}` of the same commit.
        readme: whether README shows it. minutes: about how long it takes on two cores.
    """

    name: str
    group: Group
    form: Form = "full"
    claim: str
    commands: str
    text: str
    limits: str
    figures: str = ""
    resumes: bool = False
    readme: bool = False
    minutes: float = 1.0

    def __post_init__(self) -> None:
        if not self.limits or not self.commands:
            raise InvalidValueError(f"row {self.name}: expected a command and a limit")
        self.each_limit()

    def calls(self) -> list[list[str]]:
        """The commands' argument vectors."""
        return [shlex.split(line) for line in self.commands.splitlines()]

    def needs(self) -> list[str]:
        """Paths under `{data}` that the commands name; the row is skipped where one is absent."""
        return re.findall(r"\{data\}/([\w./-]+)", self.commands)

    def each_limit(self) -> list[Limit]:
        """The limits, read."""
        return [Limit.of(text) for text in self.limits.split(", ")]

    def read(self, document: Mapping[str, Any]) -> dict[str, float | int | str | None]:
        """The row's figures of what the command has written; None for what is not there."""
        words = (name for _, name, _, _ in string.Formatter().parse(self.text) if name is not None)
        named = {name: name for name in (*words, *(limit.figure for limit in self.each_limit()))}
        for text in self.figures.split():
            name, _, there = text.partition("=")
            named[name] = there or name
        return {name: _at(document, named[name]) for name in sorted(named) if name != "seconds"}

    def holds(self, figures: Figures) -> bool:
        """Whether all limits hold."""
        return all(limit.holds(figures) for limit in self.each_limit())

    def missed(self, figures: Figures) -> str:
        """The limits that do not hold, each with its figure; "" where all do."""
        found = [
            (limit, figures.get(limit.figure)) for limit in self.each_limit() if not limit.holds(figures)
        ]
        return ", ".join(
            limit.text + (f" (it is {value:.3g})" if isinstance(value, float | int) else " (not measured)")
            for limit, value in found
        )

    def words(self, figures: Figures) -> str:
        """The figures in words; what is missing shows as a dash."""
        return _Words().vformat(self.text, (), figures)


class _Words(string.Formatter):
    def get_value(self, key: Any, args: Any, kwargs: Figures) -> Any:
        return kwargs.get(key)

    def format_field(self, value: Any, format_spec: str) -> Any:
        return "-" if value is None else super().format_field(value, format_spec)


def _at(document: Mapping[str, Any], name: str) -> float | int | str | None:
    found = document.get(name)
    if isinstance(found, float | int | str):
        return found
    parts = {key: part for key, part in document.items() if isinstance(part, Mapping)}
    key = max((key for key in parts if name.startswith(f"{key}_")), key=len, default=None)
    if key is not None:
        return _at(parts[key], name.removeprefix(f"{key}_"))
    return _at(*parts.values(), name) if len(parts) == 1 else None
