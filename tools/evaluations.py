"""Runs the studies among the tests, which a run of the tests leaves out, and counts what holds.

uv run --extra dev python -m tools.evaluations --json FILE
"""

import subprocess
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree as ET

from tools.figures import study_parser, write_figures

ROOT = Path(__file__).resolve().parent.parent


def main() -> None:
    args = study_parser(__doc__).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        command = [sys.executable, "-m", "pytest", "-q", "--evaluations", f"--junitxml={report}"]
        subprocess.run(command, cwd=ROOT, check=False)
        suite = ET.parse(report).getroot().find("testsuite")
    counts = {name: int(suite.get(name, 0)) for name in ("tests", "failures", "errors", "skipped")}
    failed = counts["failures"] + counts["errors"]
    figures = {"tests": counts["tests"], "failed": failed, "skipped": counts["skipped"]}
    write_figures(args.json, figures)


if __name__ == "__main__":
    main()
