"""Processes of `pipelines`: a cluster, or a user who runs the pipeline on it.

The arguments `cluster dask` and `cluster ray` start a cluster, which prints its address, and ends
with its standard input. The arguments `user PROGRAM ADDRESS NAME` start a user, who runs the
pipeline for each line `first count` of standard input, and prints a JSON object for each result and
at the end.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from .pipelines_work import Detector, Row


def start_dask() -> None:
    """Start two CPU workers and a worker that takes the place of a GPU worker."""
    from distributed import Nanny, Scheduler, SpecCluster

    workers: dict[str, Any] = {
        name: {"cls": Nanny, "options": {"nthreads": 1, "resources": {name[:3]: 1}}}
        for name in ("GPU-0", "CPU-0", "CPU-1")
    }
    scheduler = {"cls": Scheduler, "options": {"dashboard": False, "port": 0, "host": "127.0.0.1"}}
    with SpecCluster(workers=workers, scheduler=scheduler, silence_logs=40) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()


def start_ray() -> None:
    """Start a cluster with two CPUs and a number that takes the place of a GPU."""
    import ray

    context = ray.init(num_cpus=2, num_gpus=1, include_dashboard=False, log_to_driver=False)
    print(context.address_info["gcs_address"], flush=True)
    sys.stdin.read()
    ray.shutdown()


def connect(program: str, address: str, name: str) -> Callable[[Sequence[int]], Iterator[Row]]:
    """Return the function that runs a program's pipeline for a user of the cluster."""
    if program.startswith("ray"):
        import ray

        from . import pipelines_ray

        ray.init(address, log_to_driver=False, logging_level="ERROR")
        ray.data.DataContext.get_current().enable_progress_bars = False
        gpus = 0.5 if program == "ray_half" else 1
        return partial(pipelines_ray.detect_frames, gpus=gpus)
    from distributed import Client

    from . import pipelines_dask, pipelines_dask_map, pipelines_poolpart

    client = Client(address, name=name)
    if program == "poolpart_own":
        return partial(pipelines_poolpart.detect_frames, client, setup=Detector)
    module = {
        "dask_map": pipelines_dask_map,
        "dask": pipelines_dask,
        "poolpart": pipelines_poolpart,
    }[program]
    return partial(module.detect_frames, client)


def serve_user(program: str, address: str, name: str) -> None:
    """Run the pipeline as often as standard input requests."""
    detect_frames = connect(program, address, name)
    output = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # libraries also print

    def report(row: dict[str, Any]) -> None:
        print(json.dumps(row | {"time": time.time()}), file=output, flush=True)

    report({"event": "connected"})
    for line in sys.stdin:
        first, count = map(int, line.split())
        try:
            for row in detect_frames(range(first, first + count)):
                report(row)
        except Exception as error:
            report({"event": "end", "error": f"{type(error).__name__}: {error}"})
        else:
            report({"event": "end"})


if __name__ == "__main__":
    kind, *names = sys.argv[1:]
    if kind == "user":
        serve_user(*names)
    elif names == ["dask"]:
        start_dask()
    else:
        start_ray()
