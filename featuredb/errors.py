"""One tree of errors under `FeatureDbError`.

A message says what was expected, what was found, in which object, and what to do. Outcomes that a
user must expect (not localised, not registered, rejected by a gate) are values, not errors.
"""


class FeatureDbError(Exception):
    """Base of every error that this system raises on purpose."""


class InvalidValueError(FeatureDbError, ValueError):
    """A value breaks the rules of its type (shape, finiteness, range, unit)."""


class MissingExtraError(FeatureDbError):
    """An optional part was called whose libraries are not installed; the message names the extra."""


class GeodesyError(FeatureDbError):
    """A coordinate or CRS cannot be used: outside UTM's limits, unknown EPSG code, wrong kind of CRS."""


class ImageError(FeatureDbError):
    """An image cannot be used; `code` is one of `featuredb.features.image_header.IMAGE_ERROR_CODES`."""

    def __init__(self, message: str, code: str = "not_an_image") -> None:
        super().__init__(message, code)
        self.message = message
        self.code = code

    def __str__(self) -> str:
        return self.message


class IncompatibleExtractorError(FeatureDbError):
    """Features of one extractor meet a map of another; their descriptors cannot be compared."""


class StoreError(FeatureDbError):
    """The database cannot do what was asked: no database there, unknown map, broken table."""


class DatabaseNotFoundError(StoreError):
    """There is no database at the given place."""


class MapNotFoundError(StoreError):
    """The snapshot has no map with that id."""


class UnplacedMapError(StoreError):
    """What was asked for needs a place on Earth, and the map has none; the message says what gives it one."""


class UnplacedBesideOthersError(FeatureDbError):
    """A query names a map without a place beside other maps; its answers are in a frame of its own."""


class SnapshotNotFoundError(StoreError):
    """The database has no snapshot with that number or before that time."""


class ConflictError(StoreError):
    """Concurrent writers collided more often than the bounded retries allow."""


class ExportError(FeatureDbError):
    """Nothing can be exported so, or what was exported cannot be read back."""


class IngestError(FeatureDbError):
    """An ingest cannot go on: nothing usable in the folder, or a work folder of another job."""


class ControlFileError(FeatureDbError):
    """A control point file cannot be used; the message names the lines and what to do."""


class RegistrationError(FeatureDbError):
    """A map cannot be registered as asked: photos are missing, no scan covers it, broken picks."""


class VideoError(FeatureDbError):
    """A film or a folder of frames cannot be read or written: no film, broken, cut off, of changing size."""


class ServiceError(FeatureDbError):
    """The server answered with an error; `code` is one of the wire's error codes."""

    def __init__(self, code: str, message: str, request_id: str | None = None) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message
        self.request_id = request_id


class ScanError(FeatureDbError):
    """A scan cannot be added or loaded as asked."""


class ScanFileError(ScanError):
    """A scan's file cannot be used: not LAS or LAZ, empty, truncated, broken."""


class ScanNotFoundError(StoreError):
    """The database has no such scan, or none at all."""


class CandidateNotFoundError(StoreError):
    """The database has no such contributed photo, or no longer its image."""


class CanaryNotFoundError(StoreError):
    """The database has no such known query."""


class TelemetryError(FeatureDbError):
    """Telemetry cannot be read: no positions in it, unknown or contradictory format, damaged, too large."""
