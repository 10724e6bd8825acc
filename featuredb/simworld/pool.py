"""Pictures drawn by a pool of processes."""

import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

import cv2

T = TypeVar("T")


def in_order(draw: Callable[[int], T], count: int, workers: int = 0, chunk: int | None = 1) -> Iterator[T]:
    """`draw(i)` of all i below `count` in their order, from a pool of processes (or here, for one worker).

    Args:
        workers: processes; 0 takes one per core.
        chunk: numbers that travel to a process at a time; None: to each process a row of its own.
    """
    processes = min(workers or os.cpu_count() or 1, count)
    if processes <= 1:
        yield from map(draw, range(count))
        return
    size = chunk or -(-count // processes)
    # Spawned, not forked: the caller may have threads (Zenoh, a progress bar) that a fork would cut off.
    # OpenCV's own threads would fight over the same cores.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, cv2.setNumThreads, (1,)) as pool:
        # A few chunks ahead of the writer, so that a slow disk does not fill the memory.
        chunks = [range(first, min(first + size, count)) for first in range(0, count, size)]
        ahead = 4 * processes
        waiting = [pool.submit(_drawn, draw, numbers) for numbers in chunks[:ahead]]
        for k in range(len(chunks)):
            yield from waiting.pop(0).result()
            if k + ahead < len(chunks):
                waiting.append(pool.submit(_drawn, draw, chunks[k + ahead]))


def _drawn(draw: Callable[[int], T], numbers: range) -> list[T]:
    return [draw(number) for number in numbers]
