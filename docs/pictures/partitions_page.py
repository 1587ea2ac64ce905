"""Take a screenshot of the partitions page while two partitions work.

`python -m docs.pictures.partitions_page docs/images/partitions-page.png` divides a local
cluster, sends items from a task of the IO partition through a pipe to tasks of the GPU partition,
submits tasks of a second client, and takes a screenshot of the page with Chromium. Local workers
stand in for machines with GPUs.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Thread

from distributed import Client, LocalCluster
from docs.pictures.options import file_parser

from poolpart import Partition, Pipe, PipeFailed, Pool, n_workers, rest

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
SIZE = (800, 1010)  # pixels
CLUSTER = {
    "n_workers": 5,
    "threads_per_worker": 1,
    "dashboard_address": "127.0.0.1:0",
    "silence_logs": "ERROR",
}
ITEM_S = 0.5  # of a task for an item
ITEMS = 2000  # more than are done before the picture is taken
DONE = 6  # tasks of GPU before the picture is taken


def load(pipe: Pipe, count: int) -> None:
    """Put numbers into a pipe, waiting whenever it is full."""
    for number in range(count):
        pipe.put(number)


def shrink(number: int) -> int:
    """Simulate a task on a GPU."""
    time.sleep(ITEM_S)
    return number


def index(number: int) -> int:
    """Simulate a task on the remaining workers."""
    time.sleep(4 * ITEM_S)
    return number


@contextmanager
def page_at_work(client: Client, other_client: Client) -> Iterator[str]:
    """Divide a cluster, submit tasks to the partitions, and yield the URL of the page."""
    pool = Pool.from_client(client)
    rules = {"GPU": n_workers(2), "IO": n_workers(1), "OTHER": rest()}
    gpu, io, _ = pool.divide(rules).values()
    other = Partition("OTHER", other_client)
    with Pipe("pictures", 8, client) as pipe:
        url = pool.page()
        loading = io.submit(load, pipe, ITEMS)
        indexing = [other.submit(index, number) for number in range(40)]
        shrinking = Thread(target=_until_it_fails, args=(gpu, pipe))
        shrinking.start()
        while gpu.stats().done < DONE:
            time.sleep(ITEM_S)
        yield url
        pipe.fail("the picture is taken")
        shrinking.join()
        client.cancel([loading])
        other_client.cancel(indexing)


def _until_it_fails(gpu: Partition, pipe: Pipe) -> None:
    """Run a task for each item in a pipe until the pipe fails."""
    with suppress(PipeFailed):
        gpu.for_each(pipe, shrink)


def draw(url: str, picture: Path) -> None:
    """Take a screenshot of a page with a browser and save it as PNG.

    Raise RuntimeError if no browser is installed or if the browser fails.
    """
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        raise RuntimeError(f"The picture needs a browser, one of {', '.join(BROWSERS)}.")
    with tempfile.TemporaryDirectory() as profile:
        options = [
            "--headless=new",
            "--no-sandbox",
            "--hide-scrollbars",
            "--disable-dev-shm-usage",
            f"--user-data-dir={profile}",
            f"--window-size={SIZE[0]},{SIZE[1]}",
            f"--screenshot={picture.absolute()}",
        ]
        ended = subprocess.run([program, *options, url], capture_output=True, timeout=120)
    if ended.returncode or not picture.exists():
        raise RuntimeError(f"{program} drew no picture: {ended.stderr.decode()[-500:]}")


def main(arguments: list[str] | None = None) -> int:
    """Take the screenshot and return the exit status."""
    options = file_parser(__doc__, ".png").parse_args(arguments)
    with (
        LocalCluster(**CLUSTER) as cluster,
        Client(cluster, name="alice") as client,
        Client(cluster, name="bob") as other_client,
        page_at_work(client, other_client) as url,
    ):
        draw(url, options.file)
    return 0


if __name__ == "__main__":
    sys.exit(main())
