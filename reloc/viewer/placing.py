"""The pages on which a person places maps: each a command of its own, started for the page of the viewer."""

import os
import queue
import re
import secrets
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence

from featuredb.errors import InvalidValueError

_ADDRESS = re.compile(r"(http://\S+); stop with")
_START_S = 120.0  # the first time it imports everything and loads the map
_STOP_S = 10.0
_TOLD_CHARACTERS = 500


class PlacingPages:
    """Starts a page for a map and says where it is; one for each map, threads may share it.

    Attributes:
        key: that whoever asks must know: placing writes, and others on this machine may look only.
    """

    def __init__(self, commands: Mapping[str, Sequence[str]]) -> None:
        """
        Args:
            commands: by map id, the program and its arguments; it prints the page's address.
        """
        self.key = secrets.token_urlsafe(24)
        self._commands = commands
        self._running: dict[str, tuple[subprocess.Popen[str], str]] = {}
        self._lock = threading.Lock()

    def open(self, map_id: str, key: str) -> str:
        """The address of the page for a map; a page that is open already is given again.

        Raises:
            InvalidValueError: another key, no such map, or the command ended without an address, with what
                it said.
        """
        if not secrets.compare_digest(key.encode(), self.key.encode()):
            raise InvalidValueError("open the viewer by the whole address that it has printed to place maps")
        if map_id not in self._commands:
            raise InvalidValueError(f"expected a map without a place, found {map_id[:100]!r}")
        with self._lock:
            process, address = self._running.get(map_id, (None, ""))
            if process is None or process.poll() is not None:
                process, address = _started(self._commands[map_id])
                self._running[map_id] = process, address
            return address

    def close(self) -> None:
        """End what was started."""
        with self._lock:
            for process, _ in self._running.values():
                _end(process)
            self._running.clear()


def anchor_command(url: str, map_id: str, photos: os.PathLike[str]) -> list[str]:
    """What serves the page of picks without opening a browser of its own."""
    program = [sys.executable, "-m", "featuredb.cli"]
    return [*program, "anchor", url, map_id, "--photos", os.fspath(photos), "--page", "--no-browser"]


def _started(command: Sequence[str]) -> tuple[subprocess.Popen[str], str]:
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,  # Ctrl-C is the viewer's, which ends it
    )
    said: queue.Queue[str | None] = queue.Queue()
    threading.Thread(target=_read, args=(process, said), daemon=True).start()
    lines: list[str] = []
    while True:
        try:
            line = said.get(timeout=_START_S)
        except queue.Empty:
            line = None
        if line is None:
            _end(process)
            told = " ".join(lines)[-_TOLD_CHARACTERS:] or "nothing"
            raise InvalidValueError(f"the page could not be opened; the command said: {told}")
        found = _ADDRESS.search(line)
        if found is not None:
            return process, found.group(1)
        lines.append(line.strip())


def _end(process: "subprocess.Popen[str]") -> None:
    process.terminate()
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _read(process: "subprocess.Popen[str]", said: "queue.Queue[str | None]") -> None:
    """Every line, to the end: a pipe that nobody reads would stop the command."""
    assert process.stdout is not None
    with process.stdout as out:
        for line in out:
            said.put(line)
    said.put(None)
