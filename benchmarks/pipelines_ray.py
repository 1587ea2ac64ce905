"""The pipeline of `pipelines` in Ray Data."""

from collections.abc import Iterator, Sequence
from typing import Any

import ray

from .pipelines_work import Detector, Row, decode

BATCH = 4  # frames in a block and in a batch of the detector


def decode_row(row: dict[str, Any]) -> Row:
    return decode(row["item"])


class BatchDetector:
    """Detector for the batches of Ray Data."""

    def __init__(self) -> None:
        self.detector = Detector()

    def __call__(self, batch: dict[str, Any]) -> dict[str, list[Any]]:
        """Return the results for a batch of frames."""
        frames = [dict(zip(batch, row, strict=True)) for row in zip(*batch.values(), strict=True)]
        boxes = [self.detector.detect(frame) for frame in frames]
        return {key: [box[key] for box in boxes] for key in boxes[0]}


def detect_frames(numbers: Sequence[int], gpus: float = 1) -> Iterator[Row]:
    blocks = -(-len(numbers) // BATCH)
    frames = ray.data.from_items(list(numbers), override_num_blocks=blocks).map(decode_row)
    actors = ray.data.ActorPoolStrategy(size=1)
    boxes = frames.map_batches(
        BatchDetector, batch_size=BATCH, compute=actors, num_gpus=gpus, num_cpus=0
    )
    return iter(boxes.iter_rows())
