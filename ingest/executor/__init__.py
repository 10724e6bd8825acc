"""One interface to run many independent tasks: in this process, on a pool of processes, or on Dask.

Nothing heavy is imported here: a worker sets its thread caps before numpy, OpenCV and FAISS are loaded,
because they read them when they are.
"""

from ingest.executor.interface import Executor, InProcessExecutor, Lost, Progress, no_progress
from ingest.executor.pool import PoolExecutor, open_executor

__all__ = [
    "Executor",
    "InProcessExecutor",
    "Lost",
    "PoolExecutor",
    "Progress",
    "no_progress",
    "open_executor",
]
