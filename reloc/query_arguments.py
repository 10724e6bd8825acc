"""What commands are told of a query: prior and camera, as text."""

from pydantic import ValidationError

from featuredb.errors import InvalidValueError
from reloc.wire import CameraRequest, PriorRequest


def parse_prior(text: str | None) -> PriorRequest | None:
    """`LAT,LON,SIGMA_M`; None for None."""
    if text is None:
        return None
    try:
        lat, lon, sigma_m = (float(part) for part in text.split(","))
        return PriorRequest(lat=lat, lon=lon, sigma_m=sigma_m)
    except (ValueError, ValidationError) as error:
        raise InvalidValueError(
            f"--prior: expected LAT,LON,SIGMA_M in degrees and metres such as 47.37,8.54,25, found {text!r}"
        ) from error


def parse_camera(text: str | None) -> CameraRequest | None:
    """`MODEL,WIDTH,HEIGHT,PARAMS...`; None for None."""
    if text is None:
        return None
    try:
        model, width, height, *params = text.split(",")
        return CameraRequest(
            model=model.strip(),
            width=int(width),
            height=int(height),
            params=tuple(float(p) for p in params),
        )
    except (ValueError, ValidationError) as error:
        raise InvalidValueError(
            "--camera: expected MODEL,WIDTH,HEIGHT,PARAMS... such as "
            f"PINHOLE,4000,3000,3200,3200,2000,1500, found {text!r}"
        ) from error
