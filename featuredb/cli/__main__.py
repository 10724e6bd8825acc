"""`python -m featuredb.cli` is `featuredb`."""

import sys

from featuredb.cli.main import program

sys.exit(program())
