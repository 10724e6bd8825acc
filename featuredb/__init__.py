"""Geo-registered feature maps: photos of a place become a database that tells where later photos were taken.

`featuredb.open` gives a database; docs/python.md shows what it does.
"""

from collections.abc import Mapping
from importlib import import_module
from importlib.metadata import entry_points, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from featuredb.errors import FeatureDbError
    from featuredb.geometry.camera import Camera
    from ingest.api.database import FeatureDatabase

__version__: str

__all__ = ["Camera", "FeatureDatabase", "FeatureDbError", "__version__", "open"]

_HOMES = {"Camera": "featuredb.geometry.camera", "FeatureDbError": "featuredb.errors"}


def open(
    url: str | Path, *, create: bool = False, storage_options: Mapping[str, str] | None = None
) -> "FeatureDatabase":
    """Open a database.

    Args:
        url: its folder, or its address in an object store, such as s3://bucket/maps.
        create: make it where there is none; the folder that it lies in has to be there.
        storage_options: of the object store.

    Raises:
        DatabaseNotFoundError: there is none. StoreError: it cannot be read, or is of a newer format.
    """
    return _entry("open")(url, create=create, storage_options=storage_options)  # type: ignore[no-any-return]


def __getattr__(name: str) -> Any:
    """What `import featuredb` does not load."""
    if name == "__version__":
        return version("featuredb")
    if name == "FeatureDatabase":
        return _entry(name)
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'featuredb' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)


def _entry(name: str) -> Any:
    """What a package above this one provides, as the command line finds its subcommands."""
    (found,) = entry_points(group="featuredb.api", name=name)
    return found.load()
