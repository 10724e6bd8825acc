"""SHA256SUMS of a folder, as `sha256sum -c SHA256SUMS` reads it."""

import re
from pathlib import Path, PurePosixPath

from featuredb.errors import ExportError
from featuredb.file_digest import file_sha256

SUMS = "SHA256SUMS"

_LINE = re.compile(r"([0-9a-f]{64})  (\S.*)")


def write_sums(folder: Path) -> None:
    """List every file below the folder, by path, with its SHA-256."""
    files = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    text = "".join(f"{file_sha256(folder / name)}  {name}\n" for name in files)
    (folder / SUMS).write_text(text, encoding="utf-8")


def check_sums(folder: Path) -> frozenset[str]:
    """The files that are listed, after every one has been compared. Files that are not listed do not matter.

    Raises:
        ExportError: not a folder with SHA256SUMS; a file that is missing or differs, by name.
    """
    try:
        text = (folder / SUMS).read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise ExportError(
            f"{folder}: expected a dataset's folder with {SUMS}, cannot read that ({error})"
        ) from error
    listed: set[str] = set()
    for number, line in enumerate(text.splitlines(), start=1):
        match = _LINE.fullmatch(line)
        if match is None or not _inside(match[2]):
            raise ExportError(
                f"{folder / SUMS}, line {number}: expected a SHA-256 and a path, found {line!r:.120}"
            )
        digest, name = match.groups()
        path = folder / name
        if not path.is_file():
            raise ExportError(
                f"{path}: {SUMS} lists this file, and it is missing; copy the dataset once more"
            )
        if file_sha256(path) != digest:
            raise ExportError(
                f"{path}: the content is not what {SUMS} says; it was damaged or changed, copy it once more"
            )
        listed.add(name)
    return frozenset(listed)


def _inside(name: str) -> bool:
    path = PurePosixPath(name)
    return not path.is_absolute() and ".." not in path.parts
