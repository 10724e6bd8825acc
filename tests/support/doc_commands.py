"""The commands that the documentation shows: found by a Markdown parser, joined, taken apart."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

from markdown_it import MarkdownIt

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = (
    "featuredb",
    "uv",
    "python",
    "pip",
    "dask",
    "mkdocs",
    "curl",
    "duckdb",
    "apt-get",
    "git",
    "docker",
)

_PARSER = MarkdownIt("commonmark").enable("table")
_TOOL = re.compile(r"tools/\w+\.py")


@dataclass(frozen=True, slots=True)
class Block:
    """A block of code of a page. `language` is its info string, empty for an indented block."""

    page: str
    line: int
    language: str
    text: str


@dataclass(frozen=True, slots=True)
class Command:
    """A command as it is written, or as prose names it (`in_prose`: perhaps without its arguments)."""

    page: str
    line: int
    text: str
    in_prose: bool = False

    def __str__(self) -> str:
        return f"{self.page}:{self.line}: {self.text}"


@dataclass(frozen=True, slots=True)
class Call:
    """What a command runs: `program` is featuredb, tools/NAME.py or another program's name.

    Attributes:
        extras: of this package, that `uv run` or `pip install` asks for.
    """

    program: str
    arguments: tuple[str, ...]
    extras: tuple[str, ...] = ()


def pages() -> list[Path]:
    """The pages of the documentation."""
    return [ROOT / "README.md", ROOT / "ARCHITECTURE.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(page: str, markdown: str) -> list[Block]:
    """All blocks of code."""
    return [
        Block(page, token.map[0] + 1 + (token.type == "fence"), token.info.strip(), token.content)
        for token in _PARSER.parse(markdown)
        if token.type in ("fence", "code_block") and token.map is not None
    ]


def commands(block: Block) -> list[Command]:
    """The commands of a block for a shell: lines, joined as a shell joins them."""
    found: list[Command] = []
    text, start = "", block.line
    for number, line in enumerate(block.text.splitlines(), start=block.line):
        if not text:
            start = number
        text += line + "\n"
        if _is_whole(text):
            if shlex.split(text, comments=True):
                found.append(Command(block.page, start, text.strip()))
            text = ""
    if text:
        raise ValueError(f"{block.page}:{start}: the block ends before its command does: {text}")
    return found


def _is_whole(text: str) -> bool:
    if text.rstrip().endswith(("\\", "|")):
        return False
    try:
        shlex.split(text, comments=True)
    except ValueError:  # a quotation goes on
        return False
    return True


def prose(page: str, markdown: str) -> list[Command]:
    """Commands in running text and in tables: code that begins with a program."""
    found = []
    for token in _PARSER.parse(markdown):
        line = token.map[0] + 1 if token.map else 0
        for child in token.children or ():
            if child.type == "code_inline" and begins_with_program(child.content):
                found.append(Command(page, line, child.content, in_prose=True))
    return found


def begins_with_program(text: str) -> bool:
    """Whether this is a command, by its first word; `featuredb` alone is the name of the project."""
    first, _, rest = text.strip().partition(" ")
    return bool(_TOOL.fullmatch(first)) or (first in PROGRAMS and bool(rest))


def call_of(command: Command) -> Call:
    """Take a command apart; prose may write it as a pattern: `[--all]`, `MAP...`, `las|laz`."""
    words = shlex.split(command.text.replace("\\\n", " "), comments=not command.in_prose)
    if words[0] in ("pip", "apt-get"):
        return Call(words[0], tuple(words[1:]), _extras_of(words))
    if command.in_prose:
        words = [plain for word in words if (plain := _without_pattern(word))]
    extras = []
    if words[:2] == ["uv", "run"]:
        words = words[2:]
        while words[0] == "--extra":
            extras.append(words[1])
            words = words[2:]
    if words[0] == "python" and words[1] == "-m" and words[2].startswith("tools."):
        words = [_file_of(words[2]), *words[3:]]
    elif words[0] == "python" and _TOOL.fullmatch(words[1]):
        words = words[1:]
    return Call(words[0], tuple(words[1:]), tuple(extras))


def _file_of(module: str) -> str:
    """The file that `python -m` runs: the module's own, or that of its package."""
    path = module.replace(".", "/")
    return f"{path}/__main__.py" if (ROOT / path).is_dir() else f"{path}.py"


def _without_pattern(word: str) -> str:
    return re.sub(r"[\[\]]|\.\.\.", "", word).split("|")[0]


def _extras_of(words: list[str]) -> tuple[str, ...]:
    found = [match for word in words if (match := re.fullmatch(r"featuredb\[([\w,]+)\]", word))]
    return tuple(extra for match in found for extra in match[1].split(","))
