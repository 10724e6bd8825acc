"""Optional packages are missed by the name of the extra that brings them."""

import importlib

from featuredb.errors import MissingExtraError


def require(extra: str, what: str, *modules: str) -> None:
    """Import packages of an extra, or refuse.

    Args:
        what: needs them, as the message begins.

    Raises:
        MissingExtraError: the first that is not installed, with what to install.
    """
    for module in modules:
        try:
            importlib.import_module(module)
        except ImportError as error:
            raise MissingExtraError(
                f"{what} needs the package {module}, which is not installed: pip install 'featuredb[{extra}]'"
            ) from error
