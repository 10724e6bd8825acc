"""Optimistic writers: who was not first reads again and decides anew, some times."""

import logging
import random
import time
from collections.abc import Callable
from typing import TypeVar

from featuredb.errors import ConflictError, StoreError

logger = logging.getLogger(__name__)
T = TypeVar("T")

ATTEMPTS = 40  # 20 writers that all collide need at most 20 turns; twice that takes about a minute at most
FIRST_PAUSE_S = 0.02  # a commit on a local disk takes about 10 ms
LONGEST_PAUSE_S = 2.0


class StaleVersionError(StoreError):
    """Someone committed since the table was read: read again and decide anew."""


def retry_stale(what: str, attempt: Callable[[], T]) -> T:
    """Call `attempt` until no concurrent writer gets in between, with random pauses that grow.

    Raises:
        ConflictError: ATTEMPTS collisions in a row.
    """
    for count in range(ATTEMPTS):
        try:
            return attempt()
        except StaleVersionError:
            pause = min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 1.5**count)
            time.sleep(random.uniform(0.0, pause))
            logger.debug("%s: another writer was first, attempt %d", what, count + 2)
    raise ConflictError(
        f"{what}: {ATTEMPTS} attempts collided with other writers; nothing was committed, try again later"
    )
