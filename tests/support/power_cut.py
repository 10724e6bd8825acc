"""What a power cut leaves of a folder: only what was flushed, or also names of files whose bytes were not.

`Disk` follows a folder through the calls of `os.fsync`, and of what makes names, in this process.
"""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

State = dict[str, bytes | None]  # by path relative to the folder; None: a folder


class Disk:
    """What of a folder is on the disk; everything that is there at the beginning is."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch, on_event: Callable[[], None]) -> None:
        self._root = root
        self._files: dict[int, bytes] = {}
        self._folders: dict[int, dict[str, tuple[int, bool]]] = {}
        self._kept_open: list[int] = []  # so that no number of a file is given to another one
        for path in (root, *root.rglob("*")):
            self._take(path)
        for name in ("fsync", "link", "replace"):
            self._watch(name, monkeypatch, on_event)

    def surviving(self, *, names: bool) -> State:
        """What is there after a cut now.

        Args:
            names: files and folders that were made are there though their folder was not flushed.
        """
        return dict(self._walk(self._root.stat().st_ino, "", names))

    def _walk(self, inode: int, path: str, names: bool) -> Iterator[tuple[str, bytes | None]]:
        there = self._listing(self._root / path) if names else self._folders.get(inode, {})
        for name, (child, is_folder) in there.items():
            inner = f"{path}/{name}".lstrip("/")
            yield inner, None if is_folder else self._files.get(child, b"")
            if is_folder:
                yield from self._walk(child, inner, names)

    @staticmethod
    def _listing(folder: Path) -> dict[str, tuple[int, bool]]:
        entries = {e.name: e for e in os.scandir(folder)} if folder.is_dir() else {}
        return {
            name: (e.inode(), e.is_dir(follow_symlinks=False))
            for name, e in entries.items()
            if not e.is_symlink()
        }

    def _take(self, path: Path) -> None:
        """Note a file's bytes or a folder's names as flushed."""
        if path.is_symlink():
            return
        self._kept_open.append(os.open(path, os.O_RDONLY))
        inode = path.stat().st_ino
        if path.is_dir():
            self._folders[inode] = self._listing(path)
        else:
            self._files[inode] = path.read_bytes()

    def _watch(self, name: str, monkeypatch: pytest.MonkeyPatch, on_event: Callable[[], None]) -> None:
        real = getattr(os, name)

        def call(*args: Any, **kwargs: Any) -> Any:
            on_event()
            if name != "fsync":
                return real(*args, **kwargs)
            path = Path(f"/proc/self/fd/{args[0]}").readlink()
            if self._root in (path, *path.parents):
                self._take(path)
            return None

        monkeypatch.setattr(os, name, call)


def write_state(state: State, folder: Path) -> None:
    """Make a folder of what survived."""
    folder.mkdir()
    for path, content in state.items():
        if content is None:
            (folder / path).mkdir()
        else:
            (folder / path).write_bytes(content)
