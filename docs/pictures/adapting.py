"""Jobs, tasks and slots of two adaptive partitions on Slurm, recorded and drawn.

`python -m docs.pictures.adapting docs/images/adapting.png` starts Slurm as the current user on this
machine. The Slurm node declares 2 GPUs, so two of four GPU jobs run and two wait. GPU tasks sleep
for two seconds, and IO tasks for one. Slurm is installed from Debian packages, as in the tests.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from distributed import Client, wait
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from tests.daemons import LOOPBACK, Slurm, slurm

from lidarview.render import theme
from lidarview.render.picture_page import FONT, Page
from poolpart import Partition
from poolpart.deploy import start_partitions

NAMES = ("GPU", "IO")
MAX_WORKERS = {"GPU": 4, "IO": 3}
IDLE_S = 8
LOOK_S = 0.25
# (when, partition, tasks, seconds of each)
WORK = ((5.0, "IO", 70, 1.0), (46.0, "GPU", 24, 2.0), (97.0, "IO", 12, 1.0))
END_S = 115.0
LOSS_S = 16.0  # when a job of IO is killed, as if its host had failed
SCHEDULER = {"host": LOOPBACK, "port": 0, "dashboard_address": f"{LOOPBACK}:0"}

Sample = dict[str, Any]  # "t" and, for each partition, jobs that wait and run, slots, tasks


def look(began: float, queue: Slurm, parts: Sequence[Partition]) -> Sample:
    lines = queue.ask("squeue", "--noheader", "--format=%j %T").split("\n")
    sample: Sample = {"t": time.monotonic() - began}
    for part in parts:
        stats = part.stats()
        sample[part.name] = {
            "waiting": sum(line == f"{part.name} PENDING" for line in lines),
            "running": sum(line == f"{part.name} RUNNING" for line in lines),
            "slots": stats.slots,
            "busy": stats.busy,
            "tasks": stats.waiting + stats.queued + stats.running,
        }
    return sample


def record(folder: Path) -> list[Sample]:
    """Run the workload on a Slurm cluster and return regular samples of queue and scheduler."""
    import dask_jobqueue

    samples: list[Sample] = []
    (folder / "slurm").mkdir()
    with slurm(folder / "slurm") as queue:
        os.environ.update(queue.environment)
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
        with dask_jobqueue.SLURMCluster(
            cores=1,
            memory="1GB",
            local_directory=str(folder),
            log_directory=str(folder),
            scheduler_options=SCHEDULER,
            worker_extra_args=["--host", LOOPBACK, "--no-dashboard"],
        ) as cluster:
            common = {"idle_s": IDLE_S}
            gpu = {"adapt": [0, MAX_WORKERS["GPU"]], "job_extra_directives": ["--gres=gpu:1"]}
            jobs = {"GPU": gpu, "IO": {"adapt": [1, MAX_WORKERS["IO"]]}}
            partitions = {
                name: partition_options | common | {"job_name": name}
                for name, partition_options in jobs.items()
            }
            start_partitions(cluster, partitions)
            with Client(cluster) as client:
                parts = {name: Partition(name, client) for name in NAMES}
                while not len(parts["IO"]):
                    time.sleep(0.1)
                began = time.monotonic()
                finished = threading.Event()

                def watch() -> None:
                    while not finished.wait(LOOK_S):
                        samples.append(look(began, queue, [*parts.values()]))

                watching = threading.Thread(target=watch)
                watching.start()
                futures: dict[str, list[Any]] = {name: [] for name in NAMES}
                steps = [(start_s, "work", work) for start_s, *work in WORK]
                steps += [(LOSS_S, "loss", []), (END_S, "end", [])]
                for start_s, kind, work in sorted(steps):
                    while (remaining_s := began + start_s - time.monotonic()) > 0:
                        # Results that are held would keep their workers.
                        for unfinished in futures.values():
                            unfinished[:] = [future for future in unfinished if not future.done()]
                        time.sleep(min(remaining_s, 0.1))
                    if kind == "work":
                        name, count, seconds = work
                        futures[name] += [
                            parts[name].submit(time.sleep, seconds) for _ in range(count)
                        ]
                    elif kind == "loss":
                        lines = queue.ask("squeue", "--noheader", "--format=%i %j %T")
                        io_jobs = [
                            line.split()[0] for line in lines.splitlines() if "IO RUN" in line
                        ]
                        queue.ask("scancel", "--signal=KILL", io_jobs[-1])
                finished.set()
                watching.join()
                wait([future for unfinished in futures.values() for future in unfinished])
    return samples


def draw(samples: Sequence[Sample]) -> Page:
    """Draw tasks, jobs and slots in three charts with the same time axis."""
    page = Page((1600, 1240))
    unit = page.unit
    times = [sample["t"] for sample in samples]
    colors = dict(zip(NAMES, theme.OBJECT_COLORS, strict=False))
    limits = {"xlim": (0, END_S)}
    heights = (0.25, 0.26, 0.22)
    bottoms = (0.625, 0.335, 0.085)
    tasks = page.chart((0.085, bottoms[0], 0.70, heights[0]), **limits)
    for name in NAMES:
        counts = [sample[name]["tasks"] for sample in samples]
        tasks.step(times, counts, where="post", color=colors[name], lw=1.6 * unit)
        tasks.fill_between(times, counts, step="post", color=colors[name], alpha=0.12, lw=0)
        for start_s, partition, count, _ in WORK:
            if partition == name:
                _annotate(page, tasks, f"{count} tasks of {name}", (start_s, count), colors[name])
    tasks.set_ylabel("pending tasks")
    tasks.set_ylim(0, 1.22 * max(count for _, _, count, _ in WORK))
    for name, bottom, height in zip(NAMES, bottoms[1:], heights[1:], strict=True):
        axes = page.chart((0.085, bottom, 0.70, height), **limits)
        running, waiting, slots, busy = (
            [sample[name][key] for sample in samples]
            for key in ("running", "waiting", "slots", "busy")
        )
        jobs = [a + b for a, b in zip(running, waiting, strict=True)]
        axes.fill_between(times, running, jobs, step="post", color=theme.UNSEEN, lw=0)
        axes.fill_between(times, running, step="post", color=colors[name], alpha=0.28, lw=0)
        axes.fill_between(times, busy, step="post", color=colors[name], alpha=0.75, lw=0)
        axes.step(times, slots, where="post", color=theme.INK, lw=1.3 * unit)
        axes.set_ylabel(f"{name}: jobs, slots")
        axes.set_ylim(0, MAX_WORKERS[name] + 0.45)
        axes.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=5))
        if name == "IO":
            axes.set_xlabel("seconds")
            _annotate(
                page, axes, "a job is killed", (LOSS_S, MAX_WORKERS[name]), theme.SENSOR, mark=True
            )
        else:
            axes.tick_params(labelbottom=False)
            first = next((s["t"] for s in samples if s[name]["waiting"]), 0.0)
            _annotate(page, axes, "there are two GPUs", (first, 3.2), theme.INK)
    tasks.tick_params(labelbottom=False)
    page.key(
        [
            *(Line2D([], [], color=colors[n], lw=2.4 * unit, label=f"{n}") for n in NAMES),
            _square(theme.UNSEEN, 1.0, "job in the queue", unit),
            _square(colors["GPU"], 0.28, "job that runs", unit),
            _square(colors["GPU"], 0.8, "slot with a task", unit),
            Line2D([], [], color=theme.INK, lw=1.3 * unit, label="slots"),
        ],
        7.0,
    )
    page.title(
        "Partitions that grow with their work, on Slurm",
        f"GPU: adapt [0, {MAX_WORKERS['GPU']}], two GPUs in the cluster · "
        f"IO: adapt [1, {MAX_WORKERS['IO']}] · "
        f"jobs that are not needed for {IDLE_S} s end",
    )
    return page


def _square(color: str, alpha: float, label: str, unit: float) -> Line2D:
    mark = {"marker": "s", "ms": 6.5 * unit, "mec": "none", "alpha": alpha}
    return Line2D([], [], ls="", color=color, label=label, **mark)


def _annotate(
    page: Page,
    axes: Any,
    words: str,
    position: tuple[float, float],
    color: str,
    mark: bool = False,
) -> None:
    unit = page.unit
    if mark:
        axes.axvline(position[0], color=color, lw=0.9 * unit, ls=(0, (3, 2)))
    axes.annotate(
        words,
        position,
        xytext=(5 * unit, 5 * unit),
        textcoords="offset points",
        family=FONT,
        fontsize=6.8 * unit,
        color=color,
        va="bottom",
    )


def main(arguments: list[str] | None = None) -> None:
    """Record and draw samples, or draw recorded samples."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("picture", type=Path)
    parser.add_argument("--samples", type=Path, help="file for what is recorded; drawn if there")
    options = parser.parse_args(arguments)
    if options.samples and options.samples.exists():
        samples = json.loads(options.samples.read_text())
    else:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            samples = record(Path(folder))
        if options.samples:
            options.samples.write_text(json.dumps(samples))
    draw(samples).save(options.picture)


if __name__ == "__main__":
    main()
