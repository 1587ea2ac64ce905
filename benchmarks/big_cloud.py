"""A cloud larger than memory: delivered, merged and written under a limit on memory.

Usage: python -m benchmarks.big_cloud [--points N] [--mebibytes M] [--folder PATH]

The deliveries of a survey are made up, out of order, and go the way that a survey's go: into
the store on disk, from there in order into pieces, through Open3D into one file. The process
may allocate only so much memory besides what its libraries take (RLIMIT_DATA).
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
import open3d  # noqa: F401 - counted among the libraries

from lidarpool.ply import save_cloud
from lidarpool.scan.builder import CloudBuilder
from lidarpool.scan.messages import POINT, Part

PER_SCAN = 10_000


def limit_memory(extra: int) -> None:
    """Let this process allocate so many bytes more than it has."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    held = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmData"))
    resource.setrlimit(resource.RLIMIT_DATA, (held + extra, held + extra))


def deliver(scans: int) -> CloudBuilder:
    """Deliver that many scans, out of order."""
    table = np.zeros(PER_SCAN, POINT)
    table["cell"] = np.random.default_rng(1).integers(-90_000, 90_000, (PER_SCAN, 3))
    table["ray"] = np.arange(PER_SCAN)
    builder = CloudBuilder(scans)
    for scan in np.random.default_rng(2).permutation(scans).tolist():
        table["scan"] = scan
        builder.add(Part((scan,), (PER_SCAN,), table))
    return builder


def main(arguments: list[str] | None = None) -> dict[str, float]:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=float, default=1e8)
    parser.add_argument("--mebibytes", type=int, default=400)
    parser.add_argument("--folder", type=Path, help="where the files go; they are removed")
    options = parser.parse_args(arguments)
    scans = max(1, int(options.points) // PER_SCAN)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        tempfile.tempdir = folder
        limit_memory(options.mebibytes << 20)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        begun = time.perf_counter()
        builder = deliver(scans)
        delivered = time.perf_counter()
        size = save_cloud(Path(folder) / "cloud.ply", builder.merge(0.01, np.zeros(3)))
        ended = time.perf_counter()
        tempfile.tempdir = None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{scans * PER_SCAN:,} points, {size / 1e9:.2f} GB of .ply")
    print(f"limit   {options.mebibytes} MiB of data besides the libraries")
    print(f"peak    {peak:,.0f} MiB resident, {before:,.0f} of them before the first point")
    print(f"deliver {delivered - begun:.1f} s, merge and write {ended - delivered:.1f} s")
    return {"points": scans * PER_SCAN, "peak_mib": peak, "seconds": ended - begun}


if __name__ == "__main__":
    main()
