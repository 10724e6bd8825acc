"""Everything that must hold before a change goes in: format, lint, types, import rules, tests.

uv run --extra dev python tools/check.py            all of it; of the tests one is the demo on a small town
uv run --extra dev python tools/check.py --fast     without slow tests, of which that is one
uv run --extra dev python tools/check.py --all      also the studies, of which the whole demo is one
"""

import argparse
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# Three tests run at a time on two cores: threads of their libraries beside them would only wait for each
# other. OpenCV's even take time while they wait: a sixth of that of SIFT.
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1")
# Some machines tell Python not to keep bytecode. Then every process compiles all that it imports,
# for seconds, and tests start many processes.
_ENVIRONMENT = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"} | _ONE_THREAD


def main() -> int:
    parser = argparse.ArgumentParser(description="Run all checks of the repository.")
    much = parser.add_mutually_exclusive_group()
    much.add_argument("--fast", action="store_true", help="without slow tests, also the demo on a small town")
    much.add_argument("--all", action="store_true", help="also run the studies and the whole demo")
    args = parser.parse_args()
    python = sys.executable
    # Three at a time, as a third of the tests' time is spent waiting; a file on one worker, since modules
    # share what they have made; in the order of their folders, which leaves the short ones to the end, when
    # one worker may have to wait for the others.
    pytest = [python, "-m", "pytest", "-q", "-n", "3", "--dist", "loadfile", "--no-loadscope-reorder"]
    pytest += ["--durations", "250"]
    steps = {
        "format": [python, "-m", "ruff", "format", "--check", "."],
        "lint": [python, "-m", "ruff", "check", "."],
        "tests": [*pytest, "-m", "not slow"] if args.fast else pytest,
    }
    if args.all:
        steps["studies"] = [*pytest, "--evaluations"]
    # These take one core, and tests wait now and then: beside them they take little time of their own.
    beside = {"types": [python, "-m", "mypy"], "import rules": [str(Path(python).with_name("lint-imports"))]}
    with ThreadPoolExecutor(max_workers=1) as runs:
        said = {name: runs.submit(_run, command, subprocess.PIPE) for name, command in beside.items()}
        failed = []
        for name, command in steps.items():
            print(f"== {name}", flush=True)
            start = time.monotonic()
            failed += _told(name, _run(command).returncode, f", {time.monotonic() - start:.0f} s")
        for name, done in said.items():
            print(f"== {name}\n{done.result().stdout}", end="")
            failed += _told(name, done.result().returncode)
    print(f"failed: {', '.join(failed)}" if failed else "all checks passed")
    return 1 if failed else 0


def _run(command: list[str], out: int | None = None) -> subprocess.CompletedProcess[str]:
    both = {"stdout": out, "stderr": out and subprocess.STDOUT}
    return subprocess.run(command, cwd=ROOT, env=_ENVIRONMENT, check=False, text=True, **both)


def _told(name: str, code: int, more: str = "") -> list[str]:
    """Say how a step ended; its name if it failed."""
    print(f"== {name}: {'ok' if code == 0 else f'exit {code}'}{more}", flush=True)
    return [name] if code else []


if __name__ == "__main__":
    sys.exit(main())
