"""Optional packages: missed by the name of the extra that brings them; left out where nothing needs them."""

import importlib
import importlib.abc
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

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


class _NoPandas(importlib.abc.MetaPathFinder):
    """Says that pandas is not installed, until PyArrow's datasets are imported."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != "pandas":
            return None
        if hasattr(sys.modules.get("pyarrow.dataset"), "dataset"):  # what it defines last
            sys.meta_path.remove(self)
            return None
        raise ModuleNotFoundError(f"{fullname} is left out", name=fullname)


def leave_out_pandas() -> None:
    """Keep PyArrow from importing pandas, in a process that is ours alone.

    PyArrow's datasets have it import pandas, where that is installed, only to see whether a value is one of
    pandas': more than a second, and nothing here uses pandas. That question is asked while they are imported,
    and not again; who wants pandas later gets it, `table.to_pandas()` among them.
    """
    if "pandas" not in sys.modules:
        sys.meta_path.insert(0, _NoPandas())
