"""A scan as a database has stored it, for tests."""

import numpy as np
from deltalake import DeltaTable

from featuredb.store import Database


def stored(database: Database) -> dict[str, np.ndarray]:
    """All rows of lidar_points, read by deltalake itself, sorted by place."""
    table = DeltaTable(f"{database.url}/lidar_points").to_pyarrow_table()
    columns = {name: table[name].to_numpy() for name in table.column_names}
    order = np.lexsort([columns["height"], columns["northing"], columns["easting"]])
    return {name: values[order] for name, values in columns.items()}


def sorted_rows(xyz: np.ndarray) -> np.ndarray:
    return xyz[np.lexsort([xyz[:, 2], xyz[:, 1], xyz[:, 0]])]
