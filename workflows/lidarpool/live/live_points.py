"""The growing cloud as it is displayed: an even choice of the points delivered so far."""

from __future__ import annotations

import threading

import numpy as np
from numpy.typing import NDArray

from ..survey import Survey
from .display import DISPLAY, PointSample

LIVE_POINTS = 150_000  # in the browser at a time


class LivePoints:
    """Takes points as they are delivered, in one thread, and gives those to show to another.

    Parameters
    ----------
    survey
        The survey that the points are of.
    most
        Points that are kept.
    """

    def __init__(self, survey: Survey, most: int = LIVE_POINTS) -> None:
        self._sample = PointSample(most)
        self._lock = threading.Lock()
        self._precision_m, self._steps = survey.precision_m, survey.steps
        self._sensors = np.array([pose.position for pose in survey.poses], np.float32)

    def take(self, points: NDArray[np.void]) -> None:
        """Take points (POINT) that were delivered."""
        with self._lock:
            chosen = points[self._sample.choose(len(points))]
            rows = np.empty(len(chosen), DISPLAY)
            rows["position"] = chosen["cell"] * self._precision_m
            for name in ("scan", "ring", "object"):
                rows[name] = chosen[name]
            sensors = self._sensors[rows["scan"] // self._steps]
            rows["range"] = np.linalg.norm(rows["position"] - sensors, axis=1)
            self._sample.put(rows)

    @property
    def seen(self) -> int:
        """Points that were delivered."""
        return self._sample.seen

    @property
    def rows(self) -> NDArray[np.void]:
        """Those to show (DISPLAY); a copy."""
        with self._lock:
            return self._sample.rows
