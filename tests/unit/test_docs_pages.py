"""What readers are promised of the documentation: it is short, and names every reason for a refusal."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MOST_WORDS = 15_000
_NOT_COUNTED = ("decisions", "measurements", "measurements.md")
# Types and enumerations in which the program lists codes, and the arguments that hand one on.
_LISTS = re.compile(r"\w*(Reason|ErrorCode|ERROR_CODES)")
_ARGUMENTS = {"reason", "reason_code"}
_CODE, _LIKE_A_CODE = (
    re.compile(r"[A-Z_]{3,}|[a-z]+(_[a-z]+)*"),
    re.compile(r"([A-Z]+(?:_[A-Z]+)+|[A-Z_]{5,}(?=: [a-z]))(?:: .*)?", re.DOTALL),
)
_NO_REASONS = re.compile(
    r"FEATUREDB_.*|\w+_NUM_THREADS|XDG_CACHE_HOME|DELTA_LENGTH_BYTE_ARRAY|COLMAP|MEDIA_TYPE|[A-Z_]*(OPENCV|PINHOLE|RADIAL|FISHEYE)"
)


def test_the_pages_for_users_are_short() -> None:
    pages = [p for p in (ROOT / "docs").rglob("*.md") if p.relative_to(ROOT).parts[1] not in _NOT_COUNTED]
    words = {str(p): words_of(p.read_text(encoding="utf-8")) for p in [ROOT / "README.md", *pages]}
    assert len(words) > 20
    assert sum(words.values()) <= MOST_WORDS, f"move studies to docs/measurements, or cut: {words}"


def words_of(text: str) -> int:
    """Number of words, code included; what has no letter and no digit, as the bars of tables, is none."""
    return sum(any(c.isalnum() for c in word) for word in text.split())


def test_words_are_counted() -> None:
    assert words_of("| a | `b c` |\n|---|---|\n```sh\nls -l\n```\n") == 6


def test_troubleshooting_names_every_reason() -> None:
    said = set(re.findall(r"`([A-Za-z_]+)`", (ROOT / "docs/troubleshooting.md").read_text(encoding="utf-8")))
    modules = [p for package in ("featuredb", "ingest", "reloc") for p in (ROOT / package).rglob("*.py")]
    given: set[str] = set()
    strings: set[str] = set()
    for module in modules:  # one tree at a time: all of them together are long gone through for garbage
        tree = ast.parse(module.read_text(encoding="utf-8"))
        given.update(reasons_in(tree))
        strings.update(
            text.lower().partition(": ")[0] for node in ast.walk(tree) for text in strings_of(node)
        )
    assert given > {
        "NO_COVERAGE",
        "BUSY",
        "IDLE",
        "QUEUE_FULL",
        "NOT_BETTER",
        "LENS",
        "CANARY",
        "SLOW_BODY",
        "broken",
    }
    assert sorted(given - said) == []
    assert sorted(code for code in said if code.lower() not in strings) == []


def reasons_in(tree: ast.Module) -> Iterator[str]:
    """Codes in lists of codes, as arguments that are reasons, and strings that look like no other thing."""
    for node in ast.walk(tree):
        lists = isinstance(node, ast.ClassDef) and _LISTS.fullmatch(node.name)
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            lists = _LISTS.fullmatch(node.targets[0].id)
        if lists:
            found = [text for inner in ast.walk(node) for text in strings_of(inner) if _CODE.fullmatch(text)]
        elif isinstance(node, ast.keyword) and node.arg in _ARGUMENTS:
            found = [text for text in strings_of(node.value) if _CODE.fullmatch(text)]
        else:
            found = [m[1] for text in strings_of(node) if (m := _LIKE_A_CODE.fullmatch(text))]
        yield from (text for text in found if not _NO_REASONS.fullmatch(text))


def strings_of(node: ast.AST) -> list[str]:
    return [node.value] if isinstance(node, ast.Constant) and isinstance(node.value, str) else []


def test_the_lines_that_decide_are_where_the_architecture_says() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    rows = text.partition("## The lines that decide\n")[2].partition("\n## ")[0].splitlines()[2:]
    cells = [row.split("|")[2] for row in rows if row]
    assert len(cells) > 10
    for cell in cells:
        paths = [name for name in re.findall(r"`([\w/.]+)`", cell) if "/" in name]
        names = [name for name in re.findall(r"`(\w+)`", cell) if name not in ("maps",)]
        code = "".join((ROOT / path).read_text(encoding="utf-8") for path in paths if path.endswith(".py"))
        assert all((ROOT / path).exists() for path in paths), cell
        assert [name for name in names if not re.search(rf"\b{name}\b", code)] == [], cell


def test_pages_that_the_code_names_are_there() -> None:
    for folder in ("featuredb", "ingest", "reloc", "schemas", "tools", "deploy"):
        for path in (
            p for p in (ROOT / folder).rglob("*") if p.suffix in (".py", ".js", ".json", ".yaml", ".service")
        ):
            named = re.findall(r"\bdocs/[\w/-]+\.md\b", path.read_text(encoding="utf-8"))
            assert [name for name in named if not (ROOT / name).is_file()] == [], path
