"""How the lenses of films are named that do not say their camera: by the film's bytes, and the shot."""

UNNAMED_MAKE = "film"
_SHOT = "shot"


def unnamed_model(sha256: str) -> str:
    """The camera's model of a film that does not say it; no two films have the same."""
    return sha256[:16]


def shot_model(model: str, shot: int) -> str:
    """The camera's model of a shot, counted from 0: who cuts a film may have had several cameras."""
    return model if shot == 0 else f"{model} {_SHOT} {shot + 1}"


def is_of_film(camera_key: str, film: str) -> bool:
    """Whether an EXIF key (`featuredb.features.exif.read.camera_key`) is of some shot of a film's model."""
    start = f"{UNNAMED_MAKE}|{film}".lower()
    return camera_key.startswith((f"{start}|", f"{start} {_SHOT} "))
