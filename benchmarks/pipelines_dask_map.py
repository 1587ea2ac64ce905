"""The pipeline of `pipelines` in plain Dask, with `Client.map`."""

from collections.abc import Iterator, Sequence
from functools import cache

from distributed import Client, as_completed

from .pipelines_work import Detector, Row, decode


@cache
def load_detector() -> Detector:
    return Detector()


def detect(frame: Row) -> Row:
    return load_detector().detect(frame)


def detect_frames(client: Client, numbers: Sequence[int]) -> Iterator[Row]:
    frames = client.map(decode, numbers, resources={"CPU": 1})
    boxes = client.map(detect, frames, resources={"GPU": 1})
    del frames  # each frame is released once it has been used
    for _, box in as_completed(boxes, with_results=True):
        yield box
