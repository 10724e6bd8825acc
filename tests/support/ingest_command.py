"""`featuredb ingest ...` in this process, or as a program of its own, for tests that kill it."""

import argparse
import sys
from collections.abc import Sequence

from featuredb.cli.main import run_command
from featuredb.extras import leave_out_pandas
from ingest.cli.ingest import register


def run(words: Sequence[str]) -> int:
    """The exit code of `featuredb` with these arguments, `ingest` the first of them."""
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers(required=True))
    arguments = parser.parse_args(words)
    arguments.debug = False
    return run_command(arguments.run, arguments)


if __name__ == "__main__":
    leave_out_pandas()
    sys.exit(run(sys.argv[1:]))
