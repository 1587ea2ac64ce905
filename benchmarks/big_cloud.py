"""A cloud larger than memory: read from its parts and written under a limit on memory.

Usage: python -m benchmarks.big_cloud [--points N] [--mebibytes M] [--folder PATH]

The parts of a survey are made up; they go from storage in order into pieces, through Open3D into
one file. The process may allocate only so much memory besides what its libraries take
(RLIMIT_DATA).
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
import open3d  # noqa: F401 - counted among the libraries

from lidarpool.clouds.writing import save_cloud
from lidarpool.columns.parts import StoredCloud, pack
from lidarsim.columns.part_columns import PartColumns
from lidarsim.columns.table import ALWAYS
from lidarsim.io.storage import Storage

PER_SCAN = 20_000
PER_PART = 10  # scans


def limit_memory(extra: int) -> None:
    """Limit this process to `extra` bytes above its current data segment."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    allocated = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmData"))
    resource.setrlimit(resource.RLIMIT_DATA, (allocated + extra, allocated + extra))


def make_parts(storage: Storage, points: int) -> StoredCloud:
    """Write random parts with about `points` points; return them as a cloud."""
    rows = PER_SCAN * PER_PART
    chance = np.random.default_rng(1)
    columns = {
        column.name: chance.integers(0, 90_000 if column.name in "xyz" else 40, rows).astype(
            column.dtype
        )
        for column in ALWAYS
    }
    names = []
    storage.prepare()
    for number in range(max(1, points // rows)):
        counts = np.full(PER_PART, PER_SCAN, np.int64)
        tally = np.zeros(0, np.int32), np.zeros(0, np.int64)
        of_scans = counts.astype(np.uint32), np.zeros((PER_PART, 1, 3), np.float32)
        part = PartColumns(number * PER_PART, counts, columns, *tally, *of_scans)
        names.append(f"{number:08d}.npz")
        storage.write(names[-1], pack(part))
    cells = np.array([[0, 0, 0], [90_000] * 3], np.int64)
    firsts = range(0, PER_PART * len(names), PER_PART)
    rows_each = [rows] * len(names)
    return StoredCloud(storage, names, firsts, rows_each, ALWAYS, cells, 0.01, np.zeros(3))


def main() -> None:
    """Write a cloud under a limit on memory."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=100_000_000)
    parser.add_argument("--mebibytes", type=int, default=300)
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        cloud = make_parts(Storage.at(Path(folder) / "parts"), options.points)
        limit_memory(options.mebibytes << 20)
        began = time.perf_counter()
        path = Path(folder) / "cloud.ply"
        save_cloud(cloud, path, precision_m=0.01)
        seconds = time.perf_counter() - began
        size = path.stat().st_size
    print(
        f"{len(cloud):,} points, {size / 1e9:.2f} GB of PLY, in {seconds:.1f} s with at most "
        f"{options.mebibytes} MiB besides the libraries"
    )


if __name__ == "__main__":
    main()
