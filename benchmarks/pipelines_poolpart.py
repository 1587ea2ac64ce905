"""The pipeline of `pipelines` in poolpart."""

from collections.abc import Callable, Iterator, Sequence
from functools import cache

from distributed import Client

from poolpart import Pool

from .pipelines_work import Detector, Row, decode


@cache
def load_detector() -> Detector:  # once in each process, for the maps of all users
    return Detector()


def detect_frames(
    client: Client, numbers: Sequence[int], setup: Callable[[], Detector] = load_detector
) -> Iterator[Row]:
    pool = Pool.from_client(client)
    frames = pool["CPU"].map(decode, numbers)
    return pool["GPU"].map(Detector.detect, frames, setup=setup)
