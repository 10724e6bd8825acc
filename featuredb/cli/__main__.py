"""`python -m featuredb.cli` is `featuredb`."""

import sys

from featuredb.cli.main import main

sys.exit(main())
