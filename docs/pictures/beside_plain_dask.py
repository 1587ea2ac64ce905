"""Plot how tasks share workers in plain Dask and with partitions.

`python -m docs.pictures.beside_plain_dask docs/images/beside-plain-dask.png` runs two workloads on
three CPU workers and one GPU worker, in plain Dask and with partitions, and plots them. Processes
of this machine stand in for the workers, and all tasks sleep, so the plot does not depend on the
machine's speed. It also prints the plotted quantities.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from distributed import Client, Nanny, Scheduler, SpecCluster, get_worker
from docs.pictures.options import file_parser
from matplotlib.axes import Axes

from poolpart import Partition, Pool, named, rest

DECODE_S = 0.04  # decoding a frame on a CPU worker
DETECT_S = 0.05  # detecting objects in a frame on the GPU worker
ANSWER_S = 0.1  # answering the request of a camera on the GPU worker
REPORT_S = 0.5  # a task of another user
FRAME_BYTES = 2**20
FRAMES = 240
REQUESTS = 14  # frames of a camera, one every REQUEST_EVERY_S seconds
REQUEST_EVERY_S = 0.4
REPORTS = 40

NAMES = ("GPU", "CPU 1", "CPU 2", "CPU 3")
TITLES = {"plain": "plain Dask, resources", "partitions": "partitions"}
COLORS = {"report": "#b8bcc4", "answer": "#e8743b", "plain": "#5b6577", "partitions": "#19a979"}


class Run(NamedTuple):
    """Execution of a task. Times are in seconds."""

    kind: str
    worker: str
    begin: float
    end: float


def sleep_for(kind: str, seconds: float) -> Run:
    """Sleep, and return the execution of the current task."""
    begin = time.time()
    time.sleep(seconds)
    return Run(kind, str(get_worker().name), begin, time.time())


def decode(number: int) -> tuple[Run, bytes]:
    """Simulate the decoding of a frame, and return the frame."""
    return sleep_for("decode", DECODE_S), bytes(FRAME_BYTES)


def detect(frame: tuple[Run, bytes]) -> tuple[Run, Run]:
    """Simulate a detector on the GPU, and return the executions of both tasks."""
    return frame[0], sleep_for("detect", DETECT_S)


def answer(requested: float) -> tuple[float, Run]:
    """Simulate a detector for a single request, and return the time of the request."""
    return requested, sleep_for("answer", ANSWER_S)


def report(number: int) -> Run:
    """Simulate a task of another user."""
    return sleep_for("report", REPORT_S)


@contextmanager
def cluster_client() -> Iterator[Client]:
    """Start the workers, one of which declares a GPU."""
    options = {"nthreads": 1, "dashboard": False, "silence_logs": 50, "host": "127.0.0.1"}
    workers = {
        name: {
            "cls": Nanny,
            "options": options | ({"resources": {"GPU": 1}} if name == "GPU" else {}),
        }
        for name in NAMES
    }
    address = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
    scheduler = {"cls": Scheduler, "options": address}
    with SpecCluster(workers, scheduler, silence_logs=50) as cluster, Client(cluster) as client:
        client.wait_for_workers(len(NAMES))
        yield client


def divide(client: Client) -> tuple[Partition, Partition]:
    """Divide the workers into the partitions GPU and CPU."""
    rules = {"GPU": named("GPU", exclusive=True), "CPU": rest()}
    gpu, cpu = Pool.from_client(client).divide(rules).values()
    return gpu, cpu


def run_pipeline(mode: str) -> tuple[np.ndarray, np.ndarray]:
    """Decode frames and detect objects in them.

    Returns
    -------
    times, waiting
        Number of frames that have been decoded but not yet used, at times in seconds since the
        start. Both have shape (2 * FRAMES,).
    """
    with cluster_client() as client:
        started = time.time()
        if mode == "plain":
            frames = client.map(decode, range(FRAMES), pure=False)
            detections = client.map(detect, frames, resources={"GPU": 1}, pure=False)
            del frames  # so that Dask deletes each frame after its last use
            results = client.gather(detections)
        else:
            gpu, cpu = divide(client)
            results = list(gpu.map(detect, cpu.map(decode, range(FRAMES))))
    decoded = [decoding.end for decoding, _ in results]
    used = [detection.end for _, detection in results]
    order = np.argsort([*decoded, *used], kind="stable")
    steps = np.repeat([1, -1], FRAMES)[order]
    return np.sort([*decoded, *used]) - started, np.cumsum(steps)


def run_requests(mode: str) -> tuple[list[Run], list[float]]:
    """Answer the requests of a camera while another user's tasks run.

    Returns
    -------
    runs
        All executions. Times are relative to the start.
    waits
        Time that each request waited before its task started, in seconds.
    """
    with cluster_client() as client, ThreadPoolExecutor() as threads:
        if mode == "partitions":
            gpu, _ = divide(client)
            gpu.submit(answer, 0.0).result()  # the first task takes longer
        started = time.time()
        reporting = client.map(report, range(REPORTS), pure=False)

        def request() -> tuple[float, Run]:
            if mode == "plain":
                return client.submit(answer, time.time(), resources={"GPU": 1}).result()
            return gpu.submit(answer, time.time()).result()

        answers = []
        for _ in range(REQUESTS):
            time.sleep(REQUEST_EVERY_S)
            answers.append(threads.submit(request))
        answered = [future.result() for future in answers]
        runs = [*client.gather(reporting), *(run for _, run in answered)]
    waits = [run.begin - requested for requested, run in answered]
    return [run._replace(begin=run.begin - started, end=run.end - started) for run in runs], waits


def draw_requests(axes: Axes, mode: str, runs: list[Run], waits: list[float]) -> None:
    """Draw the tasks of each worker as bars."""
    for run in runs:
        row = NAMES.index(run.worker)
        axes.barh(row, run.end - run.begin, 0.7, run.begin, color=COLORS[run.kind], ec="white")
    axes.set(yticks=range(len(NAMES)), yticklabels=NAMES)
    axes.invert_yaxis()
    axes.set_title(f"{TITLES[mode]}: requests wait {np.mean(waits):.2f} s on average", loc="left")


def draw(picture: str) -> None:
    """Run both workloads, plot them, and print the plotted quantities."""
    figure, rows = plt.subplot_mosaic(
        [["plain", "frames"], ["partitions", "frames"]], figsize=(11, 4.4), layout="constrained"
    )
    for mode in TITLES:
        runs, waits = run_requests(mode)
        draw_requests(rows[mode], mode, runs, waits)
        rows[mode].set_xlim(0, REQUEST_EVERY_S * REQUESTS + 1)
        times, waiting = run_pipeline(mode)
        rows["frames"].step(times, waiting, where="post", color=COLORS[mode], lw=2)
        peak = int(waiting.max())
        rows["frames"].annotate(
            f"{TITLES[mode]}: up to {peak}",
            (times[waiting.argmax()], peak),
            (0, 6),
            textcoords="offset points",
            color=COLORS[mode],
        )
        print(
            f"{TITLES[mode]}: mean wait {np.mean(waits):.2f} s, longest {max(waits):.2f} s, "
            f"up to {peak} frames, {times[-1]:.1f} s"
        )
    rows["partitions"].set_xlabel("time in s")
    rows["frames"].set(
        xlabel="time in s",
        xlim=(0, None),
        ylim=(0, 1.15 * rows["frames"].get_ylim()[1]),
    )
    rows["frames"].set_title("decoded frames in memory", loc="left")
    handles = [plt.Rectangle((0, 0), 1, 1, color=COLORS[kind]) for kind in ("answer", "report")]
    labels = ["request to the GPU", "task of another user"]
    figure.legend(handles, labels, loc="outside lower left", ncols=2)
    figure.savefig(picture, dpi=110)


def main(arguments: list[str] | None = None) -> int:
    """Draw the picture and return the exit status."""
    options = file_parser(__doc__, ".png").parse_args(arguments)
    draw(options.file)
    return 0


if __name__ == "__main__":
    sys.exit(main())
