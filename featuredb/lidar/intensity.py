"""Raw intensities, whose range is each scanner's own, as bytes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True)
class IntensityStretch:
    """Linear stretch of raw intensities to 0..255; what lies outside is clipped.

    Attributes:
        low, high: raw values that become 0 and 255.
    """

    low: float
    high: float

    def apply(self, raw: NDArray[np.uint16]) -> NDArray[np.uint8]:
        """(n,) uint8 of raw values (n,) uint16."""
        scaled = (raw.astype(np.float32) - self.low) * np.float32(255.0 / (self.high - self.low))
        return np.asarray(np.rint(np.clip(scaled, 0.0, 255.0)), np.uint8)


def stretch_of(
    histogram: NDArray[np.int64], low_percent: float, high_percent: float
) -> IntensityStretch | None:
    """The stretch between two percentiles of all points of a scan.

    Args:
        histogram: (65536,) how often each raw value occurs.
        low_percent, high_percent: percentiles, 0 to 100.

    Returns:
        None where all intensities are the same: the scan has none.
    """
    values = np.flatnonzero(histogram)
    if len(values) < 2:
        return None
    cumulated = np.cumsum(histogram) / histogram.sum() * 100.0
    low = int(np.searchsorted(cumulated, low_percent, side="right"))
    high = int(np.searchsorted(cumulated, high_percent, side="left"))
    if high <= low:  # nearly all are equal: the range of all
        low, high = int(values[0]), int(values[-1])
    return IntensityStretch(low=float(low), high=float(high))
