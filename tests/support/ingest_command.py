"""`featuredb ingest ...` as a program of its own, for tests that kill it."""

import argparse
import sys

from featuredb.cli.main import run_command
from featuredb.extras import leave_out_pandas
from ingest.cli.ingest import register

if __name__ == "__main__":
    leave_out_pandas()
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers(required=True))
    arguments = parser.parse_args()
    arguments.debug = False
    sys.exit(run_command(arguments.run, arguments))
