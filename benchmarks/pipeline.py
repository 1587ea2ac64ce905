"""What the pipeline itself costs, when casting costs nothing: `python -m benchmarks.pipeline`.

The rays are trivial (a few towards one cube), so what is measured is the pipeline: pipes,
scheduler, parts. All on one local cluster:

- throughput of the four stages; several runs, the median counts;
- processor time of driver and scheduler, which share a process, for a million rays, in
  surveys of growing length.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from distributed import Client

from lidarpool import Result, Scene, Sensor, Survey, simulate
from lidarpool.run.cluster.connection import local_cluster
from lidarsim.scene.scene_mesh import SceneMesh

STAGES = ("generate", "intersect", "sort", "collect")
COST_RAYS = 64  # a scan, where the time for a million rays is measured


def cube() -> Scene:
    """Make a cube of 2 m, twelve triangles, around the sensor."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return Scene.from_meshes([SceneMesh("cube", corners, np.array(faces))])


def measure(client: Client, scans: int, rays: int, **options: Any) -> Result:
    """Run one survey of `scans` scans, each of `rays` rays."""
    sensor = Sensor.grid(rays_per_revolution=360, layers=rays, step_deg=1)
    poses = [(0.0, 0.0, 0.0)] * -(-scans // 360)
    survey = Survey(sensor, poses=poses, steps=min(scans, 360))
    result = simulate(cube(), survey, client=client, **options)
    assert sum(stage.violations for stage in result.stages) == 0
    return result


def throughput(client: Client, scans: int, rays: int, runs: int) -> dict[str, Any]:
    """Measure scans a second through all stages, and the time of each stage."""
    rates, cpu, per_item = [], [], {stage: [] for stage in STAGES}
    for _ in range(runs):
        before = time.process_time()
        result = measure(client, scans, rays)
        cpu.append((time.process_time() - before) / scans)
        rates.append(scans / result.survey_seconds)
        totals = {stage.stage: stage for stage in result.stages}
        for stage in STAGES:
            per_item[stage].append(totals[stage].seconds / totals[stage].items)
    return {
        "scans": scans,
        "rays_per_scan": rays,
        "scans_per_second": round(statistics.median(rates), 1),
        "spread": [round(min(rates), 1), round(max(rates), 1)],
        "scans_per_batch": round(scans / totals["intersect"].tasks, 1),
        "driver_and_scheduler_ms_per_scan": round(1e3 * statistics.median(cpu), 3),
        "stage_ms_per_scan": {s: round(1e3 * statistics.median(v), 3) for s, v in per_item.items()},
    }


def cost(client: Client, sizes: Sequence[int], rays: int) -> dict[str, float]:
    """Processor seconds of driver and scheduler for a million rays, by the number of scans."""
    seconds = {}
    for scans in sizes:
        before = time.process_time()
        result = measure(client, scans, rays)
        seconds[str(scans)] = round((time.process_time() - before) / (result.rays / 1e6), 3)
    return seconds


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scans", type=int, default=3600)
    parser.add_argument("--rays", type=int, default=4, help="rays a scan")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--sizes", type=int, nargs="+", default=[100, 1000, 10_000])
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    options = parser.parse_args(arguments)

    with local_cluster() as cluster, Client(cluster) as client:
        measure(client, 36, options.rays)  # the first run imports everything on the workers
        figures = throughput(client, options.scans, options.rays, options.runs)
        figures["cpu_seconds_per_million_rays"] = cost(client, options.sizes, COST_RAYS)

    show(figures)
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1) + "\n")
    return figures


def show(figures: Mapping[str, Any]) -> None:
    """Print the figures for people."""
    low, high = figures["spread"]
    print(f"{figures['scans_per_second']} scans/s (runs from {low:.0f} to {high:.0f})")
    print(f"{figures['scans_per_batch']} scans in a batch")
    print(f"driver and scheduler: {figures['driver_and_scheduler_ms_per_scan']} ms CPU a scan")
    for stage, milliseconds in figures["stage_ms_per_scan"].items():
        print(f"  {stage:<10} {milliseconds:8.3f} ms a scan, waiting included")
    for scans, seconds in figures["cpu_seconds_per_million_rays"].items():
        print(f"  {scans:>6} scans: {seconds} s of driver and scheduler for a million rays")


if __name__ == "__main__":
    main()
