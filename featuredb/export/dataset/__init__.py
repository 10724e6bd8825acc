"""The format `dataset`: maps as one self-describing folder, and back. See docs/export.md."""

from featuredb.export.dataset.read import Imported, import_dataset, read_dataset
from featuredb.export.dataset.write import write_dataset

__all__ = ["Imported", "import_dataset", "read_dataset", "write_dataset"]
