"""Resolve SDFormat poses, which are relative to named frames."""

from __future__ import annotations

from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.motion.rotations import matrices, rotations_of
from lidarsim.numerics.arrays import Floats
from lidarsim.numerics.vectors import matmul, norm
from lidarsim.scene.transform import affine, inverse_pose
from lidarsim.schema.value_texts import format_value
from lidarsim.words import did_you_mean, printable

MAX_NUMBER = 1e8  # largest number in a file, except in poses
_MAX_POSE = 1e12  # larger numbers in a pose are treated as infinite
_MIN_NORM = 1e-6  # smallest norm of a quaternion


class RelativePose(NamedTuple):
    """A pose relative to a named frame."""

    matrix: Floats  # (4, 4) matrix from the posed frame to the named frame
    frame: str  # empty for the default frame of the element


def child_numbers(
    element: Element, name: str, count: int, default: str, *, at_least: float | None = None
) -> Floats:
    """Return `count` numbers from a child element, or from `default` if it is missing or empty.

    Raises
    ------
    LidarError
        If the text does not consist of `count` finite numbers, or a number is below `at_least`.
    """
    text = (element.findtext(name) or "").strip() or default
    return parse_numbers(text, f"<{name}>", count, at_least=at_least)


def parse_numbers(
    text: str,
    subject: str,
    count: int,
    *,
    at_least: float | None = None,
    of_any_size: bool = False,
) -> Floats:
    """Parse `count` numbers from a text, which is called `subject` in error messages.

    With `of_any_size`, numbers may also be infinite, NaN, or very large. Raises LidarError as
    `child_numbers` does.
    """
    try:
        values = np.array(text.split(), np.float64)
    except ValueError:
        values = np.zeros(0)
    is_small = np.abs(values) <= MAX_NUMBER  # also False for NaN
    if len(values) != count or not (is_small.all() or of_any_size):
        expected = "a finite number" if count == 1 else f"{count} finite numbers"
        raise LidarError(f"{subject} is {format_value(text)}; it must be {expected}.")
    if at_least is not None and (values < at_least).any():
        raise LidarError(f"{subject} is {format_value(text)}; it must not be below {at_least:g}.")
    return values


def read_pose(element: Element) -> RelativePose:
    """Return an element's pose, or the identity if it has no <pose>."""
    pose = element.find("pose")
    if pose is None:
        return RelativePose(np.eye(4), "")
    frame = pose.get("relative_to") or pose.get("frame") or ""
    return RelativePose(read_matrix(pose), printable(frame))


def read_matrix(pose: Element) -> Floats:
    """Return the 4 x 4 matrix that a <pose> describes.

    The pose consists of x, y, z, and either roll, pitch, and yaw or a quaternion. In a recorded
    state, physics may have moved a model to a pose with infinite or very large numbers. The matrix
    of such a pose is NaN, except for its last row.

    Raises
    ------
    LidarError
        If the number of values is wrong, or the quaternion has zero length.
    """
    text = (pose.text or "").strip()
    is_quaternion = pose.get("rotation_format") == "quat_xyzw"
    if not text:
        return np.eye(4)
    values = parse_numbers(text, "<pose>", 7 if is_quaternion else 6, of_any_size=True)
    if not (np.abs(values) <= _MAX_POSE).all():
        return affine(np.full((3, 3), np.nan), np.full(3, np.nan))
    if is_quaternion:
        size = norm(values[3:])
        if not size > _MIN_NORM:
            raise LidarError(f"<pose> is {format_value(text)}, whose quaternion has zero length.")
        x, y, z, w = values[3:] / size
        return affine(matrices(np.array([[x, y, z, w]]))[0], values[:3])
    angles = values[3:] if pose.get("degrees") in ("true", "1") else np.degrees(values[3:])
    return affine(rotations_of(angles[::-1]) if angles.any() else np.eye(3), values[:3])


class FrameGraph:
    """The frames of a world or model, by name.

    `root` is the name of the frame of the world or model itself.
    """

    def __init__(self, root: str) -> None:
        self.root = root
        self.nested: dict[str, FrameGraph] = {}  # {name of a nested model: its frames}
        self._matrices: dict[str, Floats] = {root: np.eye(4)}  # matrices (4, 4) to the root
        self._poses: dict[str, RelativePose] = {}

    def define(self, name: str, pose: RelativePose, default: str) -> str:
        """Define a frame, and return its name. A number is appended if the name is already used.

        `default` is the reference frame if the pose does not name one.
        """
        unique = name
        number = 0
        while unique in self._poses or unique == self.root:
            unique = f"{name}_{number}"
            number += 1
        self._poses[unique] = pose._replace(frame=pose.frame or default)
        return unique

    def names(self) -> list[str]:
        """Return the names of all defined frames."""
        return [self.root, *self._poses]

    def merge(self, nested: FrameGraph, placement: Floats) -> dict[str, str]:
        """Add the frames of a merged model, and return their new names by their names in the model.

        `placement` is the matrix from the root of the merged model to the root of this graph.
        """
        names = {}
        for name in nested.names()[1:]:
            matrix = matmul(placement, nested.matrix(name))
            names[name] = self.define(name, RelativePose(matrix, self.root), self.root)
        self.nested.update({names[name]: graph for name, graph in nested.nested.items()})
        return names

    def matrix(self, name: str) -> Floats:
        """Return the 4 x 4 matrix that transforms from a frame to the root.

        Raises
        ------
        LidarError
            If a frame is not defined, or if frames refer to each other in a circle.
        """
        chain: list[str] = []
        while name not in self._matrices:
            if name in chain:
                raise LidarError(f"the frame {name[:80]!r} is relative to itself.")
            chain.append(name)
            name = self._pose(name).frame
        for link in reversed(chain):
            pose = self._poses[link]
            self._matrices[link] = matmul(self._matrices[pose.frame], pose.matrix)
        return self._matrices[chain[0] if chain else name]

    def _pose(self, name: str) -> RelativePose:
        """Return the pose of a frame. MODEL::FRAME refers to a frame of a nested model."""
        model, mark, inner = name.partition("::")
        if name not in self._poses and mark and model in self.nested:
            self._poses[name] = RelativePose(self.nested[model].matrix(inner), model)
        if name not in self._poses:
            raise LidarError(
                f"the frame {name[:80]!r} is not defined.{did_you_mean(name, self.names())}"
            )
        return self._poses[name]

    def transform_between(self, frame: str, target: str) -> Floats:
        """Return the 4 x 4 matrix that transforms from one frame to another."""
        return matmul(inverse_pose(self.matrix(target)), self.matrix(frame))


def placement_matrix(pose: Floats, frames: FrameGraph, placement_frame: str) -> Floats:
    """Return the 4 x 4 matrix of a model whose `placement_frame` has the given pose."""
    if not placement_frame:
        return pose
    return matmul(pose, inverse_pose(frames.matrix(placement_frame)))
