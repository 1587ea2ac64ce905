"""Frames and the detector of `pipelines`. This module also runs in the environment of Ray Data.

Decoding and detecting sleep, so that busy machines and missing GPUs affect all libraries equally.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np

DECODE_S = 0.08  # for each frame, on one of two CPU workers
DETECT_S = 0.05  # for each frame, on the only worker with the model
LOAD_S = 3.0  # for each model
PIXELS = 2048, 2048  # of one byte each

LOG = "PIPELINES_LOG"  # environment variable: file to which workers append what they do

Row = dict[str, Any]


def decode(number: int) -> Row:
    """Return a frame, and the process that decoded it."""
    log("decode")
    time.sleep(DECODE_S)
    pixels = np.full(PIXELS, number % 251, np.uint8)
    return {"number": number, "pixels": pixels, "decoder": os.getpid()}


class Detector:
    """Model that takes long to load."""

    def __init__(self) -> None:
        log("load")
        time.sleep(LOAD_S)

    def detect(self, frame: Row) -> Row:
        """Return the result for a frame, and the processes that computed it."""
        time.sleep(DETECT_S)
        right = frame["pixels"][0, 0] == frame["number"] % 251
        return {
            "number": int(frame["number"]),
            "right": bool(right),
            "decoder": int(frame["decoder"]),
            "detector": os.getpid(),
        }


def log(action: str) -> None:
    """Append a line to the log."""
    with Path(os.environ[LOG]).open("a") as file:
        file.write(action + "\n")
