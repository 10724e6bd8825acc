"""Values as JSON has them."""

import json
from collections import OrderedDict
from datetime import UTC, date, datetime
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from featuredb.plain_json import plain


@pytest.mark.parametrize(
    ("value", "found"),
    [
        (None, None),
        (True, True),
        (np.bool_(True), True),
        (np.int64(3), 3),
        (np.float32(0.5), 0.5),
        (np.float64(0.5), 0.5),
        (float("nan"), None),
        (np.float64("inf"), None),
        (np.array([[1.0, np.nan], [2.0, -np.inf]]), [[1.0, None], [2.0, None]]),
        ((1, {2}, frozenset([3])), [1, [2], [3]]),
        (OrderedDict({1: (2,), "a": b"\x0f"}), {"1": [2], "a": "0f"}),
        (datetime(2026, 5, 1, 12, tzinfo=UTC), "2026-05-01T12:00:00+00:00"),
        (date(2026, 5, 1), "2026-05-01"),
        (Decimal("1.50"), "1.50"),
        (Path("a", "b"), "a/b"),
    ],
)
def test_values_become_what_json_has(value: Any, found: Any) -> None:
    made = plain(value)
    assert type(made) is type(found)
    assert made == found
    assert json.loads(json.dumps(made, allow_nan=False)) == found
