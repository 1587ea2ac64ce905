"""What the live page takes of a survey: `python -m benchmarks.live`.

Surveys with and without the page, turn and turn about on one local cluster. A client that
takes everything the page sends stands for a browser on a machine of its own: one that draws
on the processor, on the same few cores, would be measured instead of the page.
"""

from __future__ import annotations

import argparse
import json
import statistics
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from distributed import Client

from lidarpool import Planning, Scene, Sensor, Survey
from lidarpool.live.live_page import live_page
from lidarpool.run.cluster.connection import local_cluster
from lidarpool.run.job_source import OneJob
from lidarpool.run.options import RunOptions
from lidarpool.run.progress import Screen
from lidarpool.run.run_page import RunPage
from lidarpool.run.runner import Kept, Run
from lidarpool.scenario.build import Job

NEWS_S = 0.5  # as the page asks
SCENE, POINTS = "surface?colour=grey", "points?colour=z&most=200000"


def job(poses: int) -> Job:
    """Make a survey of six objects with some 80 points a scan, and a short planning."""
    sensor = Sensor.grid(rays_per_revolution=3600, layers=64, step_deg=2)
    survey = Survey(sensor, [(0, 0, 1 + i / 100) for i in range(poses)], steps=180)
    return Job(Scene.seed(), survey, Planning((25, 25), (-30, -20), trials=4))


def plain(client: Client, work: Job, page: RunPage | None = None) -> float:
    """Seconds of a survey, without a page by default."""
    screen, options = Screen(lambda progress: None), RunOptions(client=client)
    return Run(OneJob(work), options, Kept(), screen, page or RunPage()).execute().survey_seconds


def watched(client: Client, work: Job) -> tuple[float, int]:
    """Seconds of a survey with a page that somebody looks at, and bytes that were sent."""
    with live_page(port=0, browser=False) as live, looking(live.page.url) as taken:
        seconds = plain(client, work, live)
    return seconds, sum(taken)


@contextmanager
def looking(url: str) -> Iterator[list[int]]:
    """Ask as an open page does, and take what is sent; gives the sizes of the answers."""
    taken: list[int] = []
    ended = threading.Event()

    def ask(what: str) -> bytes:
        with urllib.request.urlopen(f"{url}{what}", timeout=60) as answer:
            found: bytes = answer.read()
        taken.append(len(found))
        return found

    def look() -> None:
        version = None
        with suppress(OSError):  # the page has ended
            for what in ("", "page.js", "picture.js", "three.min.js", "state", SCENE):
                ask(what)
            while not ended.wait(NEWS_S):
                told = ask("news")
                header = json.loads(told[4 : 4 + int.from_bytes(told[:4], "little")])
                if header["version"] != version:
                    version = header["version"]
                    ask(POINTS)

    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield taken
    finally:
        ended.set()
        thread.join(60)


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--poses", type=int, default=40, help="of 180 scans each")
    parser.add_argument("--runs", type=int, default=5, help="of each kind")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    options = parser.parse_args(arguments)

    without, with_page, sent = [], [], 0
    work = job(options.poses)
    with local_cluster() as cluster, Client(cluster) as client:
        plain(client, job(1))  # the first run imports everything on the workers
        for _ in range(options.runs):
            without.append(plain(client, work))
            seconds, sent = watched(client, work)
            with_page.append(seconds)
            time.sleep(0.5)
    ratios = [page / bare for page, bare in zip(with_page, without, strict=True)]
    figures = {
        "scans": work.survey.scan_count,
        "seconds_without": round(statistics.median(without), 2),
        "seconds_with": round(statistics.median(with_page), 2),
        "ratio": round(sum(with_page) / sum(without), 3),
        "ratios": [round(ratio, 3) for ratio in ratios],
        "megabytes_sent": round(sent / 1e6, 4),
    }
    print(
        f"{figures['scans']} scans: {figures['seconds_without']} s without the page, "
        f"{figures['seconds_with']} s with it: {figures['ratio']} times as long "
        f"(pairs {min(ratios):.2f} to {max(ratios):.2f}; {figures['megabytes_sent']} MB sent)"
    )
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1) + "\n")
    return figures


if __name__ == "__main__":
    main()
