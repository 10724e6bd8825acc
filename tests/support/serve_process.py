"""`featuredb serve` as a process of its own."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

_PROGRAM = """
import sys
from importlib.metadata import EntryPoint
from featuredb.cli.main import build_parser, run_command
entry = EntryPoint(name="reloc", value="reloc.cli.commands:register", group="featuredb.commands")
args = build_parser([entry]).parse_args(sys.argv[1:])
sys.exit(run_command(args.run, args))
"""


class ServeProcess:
    """`featuredb serve` as a process of its own on a free port."""

    def __init__(self, *argv: object) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, "serve", *map(str, argv), "--listen", "tcp/127.0.0.1:0"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
        self.errors: list[str] = []
        # Read both pipes to their ends, so that the server never waits for us.
        self._reader = threading.Thread(target=lambda: self.errors.extend(self.process.stderr))
        self._reader.start()
        self.announced = self.process.stdout.readline()
        assert " on tcp/" in self.announced, (self.announced, self.stop())
        self.endpoint = self.announced.split(" on ")[1].split(";")[0]

    def stop(self, number: int = signal.SIGTERM) -> int:
        self.process.send_signal(number)
        code = self.process.wait(30)
        self._reader.join(10)
        self.process.stdout.close()
        self.process.stderr.close()
        return code

    @property
    def workers(self) -> list[int]:
        """Process ids of the workers, once there are some: grandchildren, since they are forked."""
        end = time.monotonic() + 20.0
        while not (found := [w for child in _children(self.process.pid) for w in _children(child)]):
            assert time.monotonic() < end, "no worker is there"
            time.sleep(0.01)
        return found

    def log(self) -> list[dict]:
        return [json.loads(line) for line in self.errors if line.startswith("{")]


def _children(pid: int) -> list[int]:
    """Process ids of a process's children, of whichever of its threads."""
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, parent = status.read_text().rpartition(")")[2].split()[:2]
        except OSError:  # it has ended meanwhile
            continue
        if int(parent) == pid and state != "Z":
            found.append(int(status.parent.name))
    return found
