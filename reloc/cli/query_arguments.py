"""What commands are told of a query: prior and camera, as text."""

from pydantic import ValidationError

from featuredb.errors import InvalidValueError
from reloc.wire.query import CameraRequest, PriorRequest


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


def parse_camera(text: str | None, sigmas: str | None = None) -> CameraRequest | None:
    """`MODEL,WIDTH,HEIGHT,PARAMS...`, and the standard deviations of PARAMS; None for None."""
    if text is None:
        if sigmas is not None:
            raise InvalidValueError("--camera-sigmas: expected --camera, too, whose parameters they are of")
        return None
    try:
        model, width, height, *params = text.split(",")
        camera = CameraRequest(
            model=model.strip(), width=int(width), height=int(height), params=tuple(float(p) for p in params)
        )
    except (ValueError, ValidationError) as error:
        raise InvalidValueError(
            "--camera: expected MODEL,WIDTH,HEIGHT,PARAMS... such as "
            f"PINHOLE,4000,3000,3200,3200,2000,1500, found {text!r}"
        ) from error
    if sigmas is None:
        return camera
    try:
        parsed = tuple(float(s) for s, _ in zip(sigmas.split(","), params, strict=True))
        return CameraRequest.model_validate({**dict(camera), "sigmas": parsed})
    except (ValueError, ValidationError) as error:
        raise InvalidValueError(
            f"--camera-sigmas: expected {len(params)} numbers, 0 or more, one for each of --camera's "
            f"parameters, found {sigmas!r}"
        ) from error


def as_arguments(camera: CameraRequest) -> str:
    """The options that give a command this camera."""
    words = [camera.model, str(camera.width), str(camera.height), *(f"{p:.8g}" for p in camera.params)]
    text = f"--camera={','.join(words)}"
    if camera.sigmas is not None:
        text += f" --camera-sigmas={','.join(f'{s:.2g}' for s in camera.sigmas)}"
    return text
