"""The pipeline of `pipelines` in plain Dask, with a bounded number of frames."""

from collections.abc import Iterator, Sequence
from functools import cache
from itertools import islice

from distributed import Client, Future, as_completed

from .pipelines_work import Detector, Row, decode

FRAMES = 16  # maximum number of frames in the cluster


@cache
def load_detector() -> Detector:
    return Detector()


def detect(frame: Row) -> Row:
    return load_detector().detect(frame)


def detect_frames(client: Client, numbers: Sequence[int]) -> Iterator[Row]:
    def submit(number: int) -> Future:
        frame = client.submit(decode, number, resources={"CPU": 1})
        return client.submit(detect, frame, resources={"GPU": 1})

    futures = map(submit, numbers)
    running = as_completed(islice(futures, FRAMES), with_results=True)
    for _, box in running:
        running.update(islice(futures, 1))
        yield box
