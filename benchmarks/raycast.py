"""Ray casting, side by side with what one would use instead: `python -m benchmarks.raycast`.

All engines that are installed cast the same rays in one process, in turns (A B C, A B C, ...),
so that whatever else the machine does befalls all of them. Rates are medians over the rounds,
with the least and the greatest; ratios are medians of the ratios within each round. On a machine
that others use, `--clock cpu` counts the processor's time instead of the wall's.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.metadata
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .raycast_engines import Cast, Engine
from .raycast_peers import ENGINES
from .raycast_scenes import Job, jobs

CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}
_CALLS_S = 0.15  # an engine's turn takes about that long at least
_VERSIONS = (
    "numpy",
    "open3d-cpu",
    "open3d",
    "trimesh",
    "numba",
    "warp-lang",
    "cupy-cuda13x",
)


def time_call(cast: Cast, repeats: int, clock: Callable[[], float]) -> tuple[float, int]:
    """Return the mean time of a call, seconds, and the number of hits."""
    start = clock()
    for _ in range(repeats):
        hits = cast()
    return (clock() - start) / repeats, hits


def measure(
    job: Job, engines: list[Engine], rounds: int, calls_s: float, clock: Callable[[], float]
) -> dict[str, Any]:
    """Measure the rates of all engines on a job."""
    ready: list[tuple[Engine, Cast, int]] = []
    builds = {}
    for engine in engines:
        start = clock()
        cast = engine.prepare(job)
        builds[engine.name] = clock() - start
        time_call(cast, 1, clock)
        call_s, _ = time_call(cast, 1, clock)
        ready.append((engine, cast, max(1, int(calls_s / max(call_s, 1e-6)))))
    rates: dict[str, list[float]] = {engine.name: [] for engine in engines}
    hits = {}
    for round_number in range(rounds):
        # Whoever is first finds the caches as the last one left them: not always the same two.
        shift = round_number % len(ready)
        for engine, cast, repeats in ready[shift:] + ready[:shift]:
            seconds, hit_count = time_call(cast, repeats, clock)
            rates[engine.name].append(engine.rays(job) / max(seconds, 1e-9) / 1e6)
            hits[engine.name] = hit_count / engine.rays(job)
    return {
        "scene": job.name,
        "triangles": len(job.faces),
        "order": job.order,
        "rays": job.rays,
        "engines": {
            engine.name: {
                "ours": engine.is_raybeam,
                "peer": engine.peer,
                "mrays_s": rates[engine.name],
                "hit_share": hits[engine.name],
                "build_s": builds[engine.name],
            }
            for engine in engines
        },
    }


def best_peer(row: dict[str, Any]) -> str | None:
    """Return the name of the peer with the highest median rate, or None without peers."""
    peers = {k: np.median(v["mrays_s"]) for k, v in row["engines"].items() if v["peer"]}
    return max(peers, key=lambda name: peers[name]) if peers else None


def ratio(row: dict[str, Any], engine: str, base: str) -> float:
    """Return the median over the rounds of the rate of an engine over the rate of `base`."""
    rates = [np.array(row["engines"][name]["mrays_s"]) for name in (engine, base)]
    return float(np.median(rates[0] / rates[1]))


def show(row: dict[str, Any]) -> None:
    """Print the ray-casting rates of all engines for a job."""
    print(f"\n{row['scene']}, {row['triangles']:,} triangles, {row['rays']:,} {row['order']} rays")
    peer = best_peer(row)
    for name, entry in row["engines"].items():
        rates = entry["mrays_s"]
        line = (
            f"  {name:<20} {np.median(rates):12.5g} Mray/s  ({min(rates):.4g} to {max(rates):.4g})"
            f"  hits {100 * entry['hit_share']:5.1f} %  prepared in {entry['build_s']:.2f} s"
        )
        if entry["ours"] and peer:
            line += f"  {ratio(row, name, peer):.3g} x {peer}"
        print(line)
    for text in findings(row):
        print(f"  {text}")


def findings(row: dict[str, Any]) -> list[str]:
    """Return sentences about the ratios that have targets."""
    engines = row["engines"]
    sentences = []
    if "Open3D, bare" in engines and "tiles" in engines:
        sentences.append(f"tiles take {ratio(row, 'tiles', 'Open3D, bare'):.2f} x bare Open3D")
    if "brute force, NumPy" in engines and "numpy" in engines:
        sentences.append(f"numpy is {ratio(row, 'numpy', 'brute force, NumPy'):,.0f} x brute force")
    return sentences


def environment(threads: int, clock: str) -> dict[str, Any]:
    """Return the machine, versions and settings of a measurement."""
    versions = {}
    for name in _VERSIONS:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": platform.machine(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "load": os.getloadavg() if hasattr(os, "getloadavg") else None,
        "threads": threads,
        "clock": clock,
        "python": platform.python_version(),
        "versions": versions,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((x.partition(":")[2].strip() for x in lines if x.startswith("model name")), "")


def main(arguments: list[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="toy scenes, few rays, two rounds")
    parser.add_argument(
        "--large", action="store_true", help="a city of 10 million triangles too: 13 GB, minutes"
    )
    parser.add_argument("--scene", action="append", help="only this one; may be given again")
    parser.add_argument("--mesh", action="append", type=Path, default=[], help="a mesh file more")
    parser.add_argument("--rays", type=int, default=1 << 17, help="rays of a scan")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--threads", type=int, default=1, help="CPU threads of those that can")
    parser.add_argument("--clock", choices=CLOCKS, default="wall")
    parser.add_argument("--without", action="append", default=[], help="leave this engine out")
    parser.add_argument("--json", type=Path, help="write the results here")
    chosen = parser.parse_args(arguments)
    quick = chosen.quick
    makers = jobs(2_000 if quick else chosen.rays, chosen.mesh, quick, chosen.large)
    unknown = set(chosen.scene or ()) - set(makers)
    if unknown:
        parser.error(f"there is no scene {', '.join(unknown)}: {', '.join(makers)}")
    engines = []
    for engine in (
        engine_class(chosen.threads)
        for engine_class in ENGINES
        if engine_class.name not in chosen.without
    ):
        reason = engine.missing()
        if reason:
            print(f"{engine.name} is left out: {reason}")
        else:
            engines.append(engine)
    results = []
    for name, make in makers.items():
        if not chosen.scene or name in chosen.scene:
            job = make()
            for order in (job, job.shuffled()):
                rounds, calls_s = (2, 0.0) if quick else (chosen.rounds, _CALLS_S)
                results.append(measure(order, engines, rounds, calls_s, CLOCKS[chosen.clock]))
                show(results[-1])
    if chosen.json:
        report = {"environment": environment(chosen.threads, chosen.clock), "jobs": results}
        chosen.json.write_text(json.dumps(report, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
