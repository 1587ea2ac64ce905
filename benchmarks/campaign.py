"""Measure the time and memory per job of a campaign, excluding ray casting.

    python -m benchmarks.campaign [--jobs N] [--toy] [--picture FILE]

Each job consists of 20 scans that form one revolution of a sensor with 64 channels. The jobs run on
a local cluster that is already running. The cost per job is the wall time minus the casting time of
each casting worker, divided by the number of jobs. `--toy` makes the jobs very small. `--picture`
plots the memory of the driver, whose process contains the scheduler, and that of the LIDAR worker.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from lidarpool import Campaign
from lidarpool.run.cluster.connection import local_client
from lidarpool.run.pipeline.stage_names import GPU
from lidarpool.run.progress import Progress

from .harness import argument_parser, write_results

MIB = 1 << 20
EVERY_S = 1.0  # between samples

BASE = """
scene: {preset: seed}
sensor: {rays_per_revolution: %d, layers: %d, step_deg: 18}
poses: [[0, 0, 1]]
steps: 20
cloud: {keep_every: 1}
materials: [{objects: "*", reflectance: 0.4, class: 6}]
"""
CAMPAIGN = """
base: base.yaml
count: %d
seed: 7
vary:
  weather.visibility_km: {log_uniform: [0.2, 20]}
  poses.0.yaw_deg: {uniform: [0, 360]}
keep: {format: kitti}
splits: {train: 0.8, val: 0.1, test: 0.1}
"""


class Samples:
    """Memory of the driver and of the LIDAR worker in MiB, with the number of finished jobs."""

    def __init__(self, lidar: int) -> None:
        self.jobs: list[int] = []
        self.driver: list[float] = []
        self.lidar: list[float] = []
        self.seconds = 0.0
        self._me = psutil.Process()
        self._worker = psutil.Process(lidar)
        self._next = 0.0

    @property
    def growth(self) -> float:
        """Growth of the driver's memory in MiB per job.

        This is the slope of a line fitted to the last half of the samples.
        """
        half = len(self.jobs) // 2
        if len({*self.jobs[half:]}) < 2:
            return 0.0
        return float(np.polyfit(self.jobs[half:], self.driver[half:], 1)[0])

    def __call__(self, progress: Progress) -> None:
        """Take a sample if the last one is old enough or all jobs are finished."""
        now_s = time.monotonic()
        if now_s >= self._next or progress.jobs_done == progress.jobs:
            self._next = now_s + EVERY_S
            self.jobs.append(progress.jobs_done)
            self.driver.append(self._me.memory_info().rss / MIB)
            self.lidar.append(self._worker.memory_info().rss / MIB)
            self.seconds = progress.seconds


def measure(jobs: int, rays: int, layers: int, folder: Path) -> tuple[dict[str, Any], Samples]:
    """Run a campaign and return its results and the memory samples."""
    (folder / "base.yaml").write_text(BASE % (rays, layers))
    (folder / "campaign.yaml").write_text(CAMPAIGN % jobs)
    campaign = Campaign.load(folder / "campaign.yaml")
    local = local_client({"LIDAR": 5})
    with local as client:
        pids = client.run(lambda dask_worker: (dask_worker.state.total_resources, os.getpid()))
        lidar = next(pid for resources, pid in pids.values() if resources.get("LIDAR"))
        casting = sum(bool(resources.get(GPU)) for resources, _ in pids.values())
        samples = Samples(lidar)
        driver_s = time.process_time()
        run = campaign.run(folder / "dataset", client=client, on_progress=samples)
        driver_s = time.process_time() - driver_s
    wall = samples.seconds
    overhead_s = (wall - run.casting_seconds / casting) / jobs
    figures = {
        "jobs": run.done,
        "failed": len(run.failed),
        "rays": run.rays,
        "wall_s": wall,
        "casting_s": run.casting_seconds,
        "casting_workers": casting,
        "beside_rays_ms_a_job": 1000 * overhead_s,
        "driver_and_scheduler_ms_a_job": 1000 * driver_s / jobs,
        "finishing_s": run.seconds - wall,
        "casting_tasks": next((s.tasks for s in run.stages if s.stage == "intersect"), 0),
        "misplaced": sum(stage.violations for stage in run.stages),
        "growth_bytes_a_job": MIB * samples.growth,
    }
    return figures, samples


def draw(samples: Samples, path: Path) -> None:
    """Plot memory over finished jobs, and save the plot to `path`."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot(samples.jobs, samples.driver, color="#2a6fb0", label="driver and scheduler")
    axes.plot(samples.jobs, samples.lidar, color="#e4752e", label="LIDAR worker")
    axes.set(
        xlabel="finished jobs", ylabel="memory (MiB)", ylim=(0, None), xlim=(0, samples.jobs[-1])
    )
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    axes.grid(visible=True, color="0.9")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="lower right")
    figure.savefig(path, dpi=120)


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argument_parser(__doc__)
    parser.add_argument("--jobs", type=int, default=1000)
    parser.add_argument("--toy", action="store_true", help="jobs of 1,000 rays")
    parser.add_argument("--picture", type=Path, help="save a plot of the memory usage to this file")
    options = parser.parse_args(arguments)
    rays, layers = (100, 10) if options.toy else (1024, 64)
    with tempfile.TemporaryDirectory(prefix="lidarpool-") as folder:
        results, samples = measure(options.jobs, rays, layers, Path(folder))
    for name, value in results.items():
        print(f"{name:<30} {value:,.1f}" if isinstance(value, float) else f"{name:<30} {value:,}")
    if options.picture:
        draw(samples, options.picture)
    write_results(options.json, results)
    return results


if __name__ == "__main__":
    main()
