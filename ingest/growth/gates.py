"""Gates of growth: each compares one figure with its limit and says so. Pure functions."""

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Gate:
    """One question and its answer.

    Attributes:
        name: for programs, e.g. "agreeing_photos".
        reason: the code that a refusal by this gate carries.
        figure: what was measured.
        limit: where the line is.
        passes: whether the figure is on the right side of it.
        message: for people, with both.
    """

    name: str
    reason: str
    figure: float
    limit: float
    passes: bool
    message: str

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        figure = None if not np.isfinite(self.figure) else round(float(self.figure), 6)
        return {"figure": figure, "limit": self.limit, "passes": self.passes}
