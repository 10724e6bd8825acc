"""A process that writes to a database, for tests of concurrency and of crashes.

    python -m tests.support.store_worker URL KEY=VALUE,... commit SEED...
    python -m tests.support.store_worker URL KEY=VALUE,... die-before-write N SEED

Prints "ready", waits for a line on stdin, then works. `commit` prints the ids of the maps that it created.
`die-before-write N` kills itself with SIGKILL just before its Nth write (0, 1, 2: child tables; 3: maps).
"""

import os
import signal
import sys
from typing import Any

from featuredb.extras import leave_out_pandas
from featuredb.store import Database
from featuredb.store import delta as delta_module
from tests.support.maps import random_map


def main(url: str, options: str, task: str, *arguments: str) -> None:
    storage_options = dict(pair.split("=", 1) for pair in options.split(",") if pair)
    database = Database.open(url, storage_options=storage_options)
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    sys.stdin.readline()
    if task == "die-before-write":
        _die_before_write(int(arguments[0]))
        arguments = arguments[1:]
    for seed in arguments:
        result = database.commit_map(random_map(int(seed)))
        if result.created:
            sys.stdout.write(f"{result.map_id}\n")


def _die_before_write(number: int) -> None:
    real, count = delta_module.write_deltalake, 0

    def write(*args: Any, **kwargs: Any) -> None:
        nonlocal count
        if count == number:
            os.kill(os.getpid(), signal.SIGKILL)
        count += 1
        real(*args, **kwargs)

    delta_module.write_deltalake = write


if __name__ == "__main__":
    leave_out_pandas()
    main(*sys.argv[1:])
