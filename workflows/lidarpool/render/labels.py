"""Where the numbers and names of the axes go, around the ground of a shot."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .stage import Axis, Stage

Floats = NDArray[np.float64]

# In pixels of a picture 1600 wide.
TICK = 7.0  # length of a tick mark
BESIDE, BELOW = 14.0, 24.0  # from an edge to the numbers right or left of it, and under it
LETTER = 12.0  # width of a digit
TITLE = 32.0  # from the numbers to the title
APART = 34.0  # numbers stand at least this far apart
SHORTEST_AXIS = 36.0  # a shorter height axis has no room for numbers


@dataclass(frozen=True, eq=False)
class Label:
    """A piece of text in pixel coordinates.

    Parameters
    ----------
    text, place
        What it says, and (2,) where its middle is.
    angle_deg
        Anticlockwise.
    mark
        (2, 2) ends of its tick mark; None for a title.
    """

    text: str
    place: Floats
    angle_deg: float = 0.0
    mark: Floats | None = None


def axis_labels(stage: Stage, camera: Camera) -> tuple[list[Label], list[Floats]]:
    """Labels of the three axes, and the lines (2, 2) in pixels that they stand along.

    x and y stand along the ground's near edges, z at its leftmost corner.
    """
    scale = camera.size[0] / 1600
    labels: list[Label] = []
    lines: list[Floats] = []
    for axis, start, end, outward in _edges(stage, camera):
        ends, _ = camera.project(np.stack([start, end]))
        length = float(np.linalg.norm(ends[1] - ends[0]))
        if axis.name == "z" and length < SHORTEST_AXIS * scale:
            continue
        if axis.name == "z":
            lines.append(ends)
        labels += _numbers(axis, start, end, camera, outward, labels)
        angle = math.degrees(math.atan2(ends[0, 1] - ends[1, 1], ends[1, 0] - ends[0, 0]))
        angle = (angle + 90) % 180 - 90 if axis.name != "z" else 90.0
        widest = max((len(text) for text in axis.labels), default=0)
        away = (_clear(outward) + TITLE + LETTER * widest * abs(outward[0])) * scale
        labels.append(Label(axis.title, ends.mean(axis=0) + away * outward, angle))
    return labels, lines


def _edges(stage: Stage, camera: Camera) -> list[tuple[Axis, Floats, Floats, Floats]]:
    """For each axis: itself, two ends in 3-D, and its outward direction in the picture."""
    corners = stage.corners
    flat, _ = camera.project(corners)
    middle, _ = camera.project(corners.mean(axis=0)[None])
    sides = {0: ((0, 1), (3, 2)), 1: ((0, 3), (1, 2))}  # corners along x and along y
    out = []
    for k, pair in sides.items():
        a, b = max(pair, key=lambda side: float(flat[list(side), 1].mean()))
        along = flat[b] - flat[a]
        outward = np.array([along[1], -along[0]]) / max(float(np.linalg.norm(along)), 1e-9)
        if outward @ ((flat[a] + flat[b]) / 2 - middle[0]) < 0:
            outward = -outward
        out.append((stage.axes[k], corners[a], corners[b], outward))
    foot = corners[int(np.argmin(flat[:, 0]))]
    top = foot.copy()
    top[2] = stage.bounds[1, 2]
    out.append((stage.axes[2], foot, top, np.array([-1.0, 0.0])))
    return out


def _numbers(
    axis: Axis, start: Floats, end: Floats, camera: Camera, outward: Floats, taken: list[Label]
) -> list[Label]:
    """Numbers of one axis that keep clear of each other and of those taken."""
    scale = camera.size[0] / 1600
    k = "xyz".index(axis.name)
    places = np.repeat(start[None], len(axis.ticks), axis=0)
    places[:, k] = axis.ticks
    pixels, _ = camera.project(places)
    out: list[Label] = []
    for pixel, text in zip(pixels, axis.labels, strict=True):
        wide = LETTER / 2 * len(text) * abs(outward[0])
        place = pixel + (_clear(outward) + wide) * scale * outward
        others = [label.place for label in (*taken, *out)]
        apart = (APART + 4 * max(0, len(text) - 3)) * (0.7 if k == 2 else 1.0) * scale
        if all(float(np.linalg.norm(place - other)) >= apart for other in others):
            out.append(Label(text, place, mark=np.stack([pixel, pixel + TICK * scale * outward])))
    return out


def _clear(outward: Floats) -> float:
    """Distance from an edge to its numbers."""
    return float(BESIDE * abs(outward[0]) + BELOW * abs(outward[1]))
