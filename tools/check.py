"""Everything that must hold before a change goes in: format, lint, types, import rules, tests, the demo.

uv run --extra dev python tools/check.py            all of it
uv run --extra dev python tools/check.py --fast     without slow tests and without the demo
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# Two tests run at a time on two cores: threads of their libraries beside them would only wait for each other.
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


def main() -> int:
    parser = argparse.ArgumentParser(description="Run all checks of the repository.")
    parser.add_argument("--fast", action="store_true", help="leave out slow tests and the demo")
    fast = parser.parse_args().fast
    python = sys.executable
    # Two at a time, a file on one worker each, since modules share what they have made; in the order of
    # their folders, which leaves the short ones to the end, when one worker may have to wait for the other.
    # Studies (marked as evaluations) are rows of the scoreboard.
    tests = [python, "-m", "pytest", "-q", "-n", "2", "--dist", "loadfile", "--no-loadscope-reorder"]
    tests += ["--durations", "250"]
    tests += ["-m", "not slow"] if fast else []
    with tempfile.TemporaryDirectory() as folder:
        steps = [
            ("format", [python, "-m", "ruff", "format", "--check", "."]),
            ("lint", [python, "-m", "ruff", "check", "."]),
            ("types", [python, "-m", "mypy"]),
            ("import rules", [str(Path(python).with_name("lint-imports"))]),
            ("tests", tests),
        ]
        if not fast:
            demo = [python, "-m", "featuredb.cli", "demo", "--size", "short", "--out", f"{folder}/demo"]
            steps.append(("demo", demo))
        failed = [name for name, command in steps if not _passes(name, command)]
    print(f"failed: {', '.join(failed)}" if failed else "all checks passed")
    return 1 if failed else 0


def _passes(name: str, command: list[str]) -> bool:
    print(f"== {name}", flush=True)
    start = time.monotonic()
    code = subprocess.run(command, cwd=ROOT, env=os.environ | _ONE_THREAD, check=False).returncode
    print(f"== {name}: {'ok' if code == 0 else f'exit {code}'}, {time.monotonic() - start:.0f} s", flush=True)
    return code == 0


if __name__ == "__main__":
    sys.exit(main())
