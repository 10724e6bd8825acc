"""Runs the commands of a page of the documentation, one after the other, in a prepared folder."""

import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

from featuredb.cli.main import main
from tests.support.doc_commands import Command, call_of
from tests.support.doc_folder import placeholders

# Commands that serve until they are stopped, and how they show that they do: the port on which they answer,
# or what they write.
_SERVING: dict[tuple[str, ...], int | str] = {
    ("featuredb", "serve"): '"event": "serving"',  # it listens before it answers
    ("featuredb", "gateway"): 8080,
    ("featuredb", "view"): "http://127.0.0.1:",
    ("featuredb", "grow", "--watch"): "watching ",
    ("featuredb", "anchor", "--page"): "http://127.0.0.1:",
    ("dask", "scheduler"): 8786,
    ("dask", "worker"): "Registered to:",
}
_PORTS = {("featuredb", "serve"): 7447, ("featuredb", "gateway"): 8080, ("dask", "scheduler"): 8786}
_READY_S, _STOPPED_S, _SHELL_S = 60.0, 30.0, 120.0


class CommandFailedError(AssertionError):
    """A command of the documentation did not do what it should."""


def serves(command: Command) -> bool:
    """Whether the command runs until it is stopped."""
    return _kind(command) is not None


def ports(commands: list[Command]) -> list[int]:
    """Ports that the commands listen on."""
    kinds = [_kind(command) for command in commands]
    return [_PORTS[kind] for kind in kinds if kind in _PORTS]


def is_free(port: int) -> bool:
    """Whether nobody listens on this port of this machine."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) != 0


def _kind(command: Command) -> tuple[str, ...] | None:
    call = call_of(command)
    words = {call.program, *call.arguments}
    if "--static" in words:  # `featuredb view` then writes a file
        return None
    first = (call.program, *call.arguments[:1])
    return next((kind for kind in _SERVING if kind[:2] == first and words.issuperset(kind)), None)


@dataclass(slots=True)
class PageRun:
    """The commands of one page; those that serve are stopped when it is left.

    Attributes:
        folder: what the commands name is there, and `home` below it is `~`.
    """

    folder: Path
    _processes: list[tuple[Command, "subprocess.Popen[bytes]"]] = field(default_factory=list)

    def __enter__(self) -> "PageRun":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        ends = [(command, self._stop(process)) for command, process in reversed(self._processes)]
        if kind is None:
            for command, (code, output) in ends:
                if code != 0 and command.text.startswith(("featuredb", "uv run")):
                    raise CommandFailedError(f"{command}\nexit code {code} when it was stopped\n{output}")

    def run(self, command: Command) -> None:
        """Run one command; one that serves goes on beside the next ones.

        Raises:
            CommandFailedError: the exit code is not 0, or nobody answers.
        """
        start = time.monotonic()
        text = self._filled_in(command.text)
        here = Command(command.page, command.line, text)
        try:
            if serves(command):
                self._start(here)
            else:
                self._run_to_the_end(here)
        finally:
            print(f"{time.monotonic() - start:6.1f} s  {command}")  # shown where a test fails, or by -rP

    def _filled_in(self, text: str) -> str:
        values = placeholders(self.folder / "my.db")
        return re.sub(r"\b(?:MAP|OTHER_MAP|SCAN|V|HOST)\b", lambda m: values.get(m[0], m[0]), text)

    def _run_to_the_end(self, command: Command) -> None:
        call = call_of(command)
        if call.program == "featuredb" and not _needs_shell(command.text):
            # In this process, since starting Python and its libraries takes longer than most commands.
            code, output = main([self._at_home(word) for word in call.arguments]), "its output is above"
        else:
            done = subprocess.run(
                ["bash", "-c", command.text],
                cwd=self.folder,
                env=self._environment(),
                capture_output=True,
                text=True,
                check=False,
                timeout=_SHELL_S,
            )
            code, output = done.returncode, done.stdout + done.stderr
        if code != 0:
            raise CommandFailedError(f"{command}\nexit code {code}\n{output}")

    def _start(self, command: Command) -> None:
        call = call_of(command)
        words = [call.program, *(self._at_home(word) for word in call.arguments)]
        path = self.folder / f"server-{len(self._processes)}.log"
        with path.open("wb") as log:
            process = subprocess.Popen(
                ["bash", "-c", f"exec {shlex.join(words)}"],
                cwd=self.folder,
                env=self._environment(),
                stdout=log,
                stderr=subprocess.STDOUT,
                preexec_fn=_on_one_core if call.program == "dask" else None,
            )
        kind = _kind(command)
        assert kind is not None
        sign = _SERVING[kind]

        def ready() -> bool:
            if isinstance(sign, int):
                return not is_free(sign)
            return sign in path.read_text()

        _wait(lambda: process.poll() is not None or ready(), _READY_S)
        if process.poll() is not None or not ready():
            _, output = self._stop(process)
            raise CommandFailedError(f"{command}\ndoes not serve\n{output}")
        self._processes.append((command, process))

    def _stop(self, process: "subprocess.Popen[bytes]") -> tuple[int, str]:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(_STOPPED_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        logs = sorted(self.folder.glob("server-*.log"))
        return process.returncode, "\n".join(log.read_text() for log in logs)

    def _at_home(self, word: str) -> str:
        return f"{self.folder / 'home'}{word[1:]}" if word.startswith("~/") else word

    def _environment(self) -> dict[str, str]:
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        return {**os.environ, "PATH": path, "HOME": str(self.folder / "home"), "BROWSER": "true"}


def _on_one_core() -> None:
    """So that Dask has one worker: each begins with seconds of imports."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def _needs_shell(text: str) -> bool:
    lexer = shlex.shlex(text, posix=True, punctuation_chars=True)
    return any(set(word) <= set("();<>|&") or "$(" in word for word in lexer)


def _wait(true: Callable[[], bool], seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end and not true():
        time.sleep(0.05)
