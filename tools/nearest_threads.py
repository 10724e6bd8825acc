"""How long the exact search takes with one and with two OpenMP threads, beside whatever else runs.

uv run python tools/nearest_threads.py
"""

import argparse
import time

import faiss
import numpy as np


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--points", type=int, nargs="+", default=[5000, 10_000, 15_000])
    parser.add_argument("--repeat", type=int, default=5)
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    query = rng.integers(0, 120, (3000, 128)).astype(np.float32)
    print(f"{'points':>8}{'1 thread ms':>14}{'2 threads ms':>14}{'ratio':>8}")
    for points in args.points:
        base = rng.integers(0, 120, (points, 128)).astype(np.float32)
        one, two = (_median_ms(query, base, threads, args.repeat) for threads in (1, 2))
        print(f"{points:>8}{one:>14.0f}{two:>14.0f}{two / one:>8.2f}")


def _median_ms(query: np.ndarray, base: np.ndarray, threads: int, repeat: int) -> float:
    faiss.omp_set_num_threads(threads)
    times = []
    for _ in range(repeat + 1):  # the first one warms up
        start = time.perf_counter()
        faiss.knn(query, base, 3)
        times.append(time.perf_counter() - start)
    return 1000.0 * float(np.median(times[1:]))


if __name__ == "__main__":
    main()
