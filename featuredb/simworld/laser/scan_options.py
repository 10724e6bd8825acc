"""What can be chosen about an airborne scan of the town."""

from dataclasses import dataclass, field

from featuredb.simworld.town.days import DayOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class AirborneScanOptions:
    """An airborne scan. The same options and scene give the same points.

    Attributes:
        seed: of everything random.
        height_m: of the flight over the town's origin.
        max_scan_angle_deg: to either side.
        overlap: share of a swath that the neighbouring strip covers too.
        heading_deg: of the first strip, clockwise from north; None draws it.
        density_per_m2: pulses of one strip per square metre of its swath; overlaps have twice that.
        margin_m: how far the scan reaches beyond the town.
        range_noise_m: standard deviation along the beam.
        strip_shift_m: standard deviation of each strip's displacement from their mean, per axis; half of it
            in height.
        divergence_mrad: full angle of the beam.
        sway_deg: amplitude of the aircraft's roll and pitch; they are known, and only unsettle the pattern.
        birds, multipath: shares of pulses whose only return is above the town, or below its ground.
        noise_labelled: share of these that carry a class of noise; the rest is unclassified.
        day: what differs from the day of the photos.
    """

    seed: int = 1
    height_m: float = 420.0
    max_scan_angle_deg: float = 20.0
    overlap: float = 0.3
    heading_deg: float | None = None
    density_per_m2: float = 8.0
    margin_m: float = 30.0
    range_noise_m: float = 0.025
    strip_shift_m: float = 0.02
    divergence_mrad: float = 0.3
    sway_deg: float = 0.15
    birds: float = 1e-4
    multipath: float = 2e-4
    noise_labelled: float = 0.7
    day: DayOptions = field(default_factory=lambda: DayOptions(seed=2))
