"""Throughput of the four stages when casting costs nothing: `python -m benchmarks.pipeline`.

The rays are trivial (a few towards one cube), so what is measured is the pipeline: pipes,
scheduler, ledger. Several runs on one local cluster; the median counts.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path

import numpy as np
from distributed import Client

from lidarpool import Result, Scene, Sensor, Survey, simulate
from lidarpool.mesh import Mesh
from poolpart import local_cluster, placement_violations

STAGES = ("generate", "intersect", "sort", "collect")


def cube() -> Scene:
    """Make a cube of 2 m, twelve triangles, around the sensor."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return Scene.from_meshes([Mesh("cube", corners, np.array(faces))])


def measure(client: Client, scans: int, rays: int) -> Result:
    """Run one survey of `scans` scans, each of `rays` rays."""
    sensor = Sensor(rays_per_revolution=360, layers=rays, step_deg=1)
    poses = [(0.0, 0.0, 0.0)] * -(-scans // 360)
    survey = Survey(sensor, poses=poses, steps=min(scans, 360))
    return simulate(cube(), survey, client=client)


def main(arguments: list[str] | None = None) -> dict[str, object]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=3600)
    parser.add_argument("--rays", type=int, default=4, help="rays a scan")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    options = parser.parse_args(arguments)

    rates, cpu, per_item = [], [], {stage: [] for stage in STAGES}
    with local_cluster() as cluster, Client(cluster) as client:
        measure(client, 36, options.rays)  # the first run imports everything on the workers
        for _ in range(options.runs):
            before = time.process_time()
            result = measure(client, options.scans, options.rays)
            cpu.append((time.process_time() - before) / options.scans)
            rates.append(options.scans / result.survey_seconds)
            assert not placement_violations(result.records)
            for stage in STAGES:
                records = [r for r in result.records if r.stage == stage]
                work = sum(r.seconds for r in records)
                per_item[stage].append(work / sum(r.items for r in records))
            tasks = sum(r.stage == "intersect" for r in result.records)

    figures: dict[str, object] = {
        "scans": options.scans,
        "rays_per_scan": options.rays,
        "scans_per_second": round(statistics.median(rates), 1),
        "spread": [round(min(rates), 1), round(max(rates), 1)],
        "scans_per_batch": round(options.scans / tasks, 1),
        "driver_and_scheduler_ms_per_scan": round(1e3 * statistics.median(cpu), 3),
        "stage_ms_per_scan": {s: round(1e3 * statistics.median(v), 3) for s, v in per_item.items()},
    }
    print(f"{figures['scans_per_second']} scans/s (runs from {min(rates):.0f} to {max(rates):.0f})")
    print(f"{figures['scans_per_batch']} scans in a batch at the end")
    print(f"driver and scheduler: {figures['driver_and_scheduler_ms_per_scan']} ms CPU a scan")
    for stage, milliseconds in figures["stage_ms_per_scan"].items():
        print(f"  {stage:<10} {milliseconds:8.3f} ms a scan, waiting included")
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1) + "\n")
    return figures


if __name__ == "__main__":
    main()
