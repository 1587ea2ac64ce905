"""Labels of inserted objects in the format of the KITTI object benchmark."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidarfiles.clouds.boxes import SweepBoxes
from lidarfiles.clouds.kitti_boxes import LEVEL_CAMERA, read_calibration
from lidarsim.errors import LidarError
from lidarsim.motion.rotations import matrices
from lidarsim.numerics.arrays import Floats

from ..augmented_sweep import AugmentedSweep
from ..object_classes import find_class

IMAGE_SIZE = (1242, 375)  # size of most KITTI images, width and height in pixels
# Objects of which at least this fraction is visible have the occlusions 0 (fully visible) and 1
# (partly occluded). Less visible objects have the occlusion 2 (largely occluded). nuScenes has the
# same limits between its visibility levels.
_FULLY_VISIBLE = 0.8
_PARTLY_VISIBLE = 0.4
_UNKNOWN_OCCLUSION = 3
_MIN_DEPTH_M = 0.1  # depth at which edges of boxes behind the camera are cut
_TYPES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc")
# Corners of a box from -0.5 to 0.5, and the corners that its edges connect.
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_EDGES = np.array([(i, j) for i in range(8) for j in range(i) if bin(i ^ j).count("1") == 1])


def occlusion(visibility: float | None) -> int:
    """Return the KITTI occlusion of an object, given the visible fraction of its pulses.

    Examples
    --------
    >>> [occlusion(share) for share in (1.0, 0.8, 0.5, 0.1, None)]
    [0, 0, 1, 2, 3]
    """
    if visibility is None:
        return _UNKNOWN_OCCLUSION
    if visibility >= _FULLY_VISIBLE:
        return 0
    return 1 if visibility >= _PARTLY_VISIBLE else 2


class Label(NamedTuple):
    """Label of an inserted object."""

    object: int  # number in the `object` column
    kind: str  # type of the object, such as "Car"
    truncation: float  # fraction of the object outside the image, 0 to 1
    values: str  # occlusion, alpha, image box, size, position and rotation_y

    @property
    def line(self) -> str:
        """Line of a file in `label_2`."""
        return f"{self.kind} {self.truncation:.2f} {self.values}\n"

    def track_line(self, frame: int) -> str:
        """Return the line of a file in `label_02`, whose track ID is the instance number."""
        return f"{frame} {self.object + 1} {self.kind} 0 {self.values}\n"


@dataclass(frozen=True, eq=False)
class KittiCamera:
    """The camera to which labels refer.

    Attributes
    ----------
    from_lidar
        Transformation from the lidar to the rectified camera frame, with shape (4, 4).
    projection
        Projection to the image, with shape (3, 4), or None if there are no images.
    image_size
        Width and height of the image in pixels.
    """

    from_lidar: Floats
    projection: Floats | None = None
    image_size: tuple[int, int] = IMAGE_SIZE

    @classmethod
    def from_sequence(cls, path: Path) -> KittiCamera:
        """Read the file `calib.txt` of a sequence, which may not exist."""
        if not path.exists():
            return cls(LEVEL_CAMERA)
        rows = read_calibration(path)
        from_lidar = _square(rows["Tr"]) if "Tr" in rows else LEVEL_CAMERA
        return cls(from_lidar, _projection(rows))

    @classmethod
    def from_object_benchmark(cls, path: Path, image: Path) -> KittiCamera:
        """Read the calibration file and the image size of a frame in the object benchmark.

        Raises LidarError if the calibration is incomplete.
        """
        rows = read_calibration(path)
        if missing := [name for name in ("R0_rect", "Tr_velo_to_cam") if name not in rows]:
            raise LidarError(
                f"{path.name} has no `{missing[0]}:` line, which is required for the labels of "
                "inserted objects. Add this line, or remove `label_2` to write no labels."
            )
        rectification = np.eye(4)
        rectification[:3, :3] = rows["R0_rect"].reshape(3, 3)
        from_lidar = rectification @ _square(rows["Tr_velo_to_cam"])
        return cls(from_lidar, _projection(rows), _image_size(image))

    def labels(self, augmented: AugmentedSweep) -> Iterator[Label]:
        """Yield the labels of the inserted objects that have points.

        Objects outside the image have no labels, as in KITTI. The position is the center of the
        bottom face, and boxes are only rotated about the vertical axis of the camera.
        """
        boxes = augmented.boxes
        rotation = self.from_lidar[:3, :3]
        forward = (rotation @ matrices(boxes.quaternions))[:, :, 0]
        positions = boxes.centers @ rotation.T + self.from_lidar[:3, 3]
        positions[:, 1] += boxes.sizes[:, 2] / 2
        rotation_y = np.arctan2(-forward[:, 2], forward[:, 0])
        alpha = rotation_y - np.arctan2(positions[:, 0], positions[:, 2])
        alpha = np.angle(np.exp(1j * alpha))  # between -pi and pi
        visibility = augmented.visibility
        for row in np.flatnonzero(boxes.points > 0).tolist():
            image_box = self._image_box(boxes, row)
            if image_box is None:
                continue
            corners, truncation = image_box
            share = float(visibility[row]) if len(visibility) == len(boxes) else None
            size = boxes.sizes[row, ::-1]  # height, width and length
            numbers = [alpha[row], *corners, *size, *positions[row], rotation_y[row]]
            values = " ".join(f"{number:.4f}" for number in numbers)
            kind = label_type(boxes.types[row])
            values = f"{occlusion(share)} {values}"
            yield Label(int(boxes.objects[row]), kind, truncation, values)

    def _image_box(self, boxes: SweepBoxes, row: int) -> tuple[list[float], float] | None:
        """Return the box of an object in the image, and the truncated fraction of the box.

        Returns zeros if there are no images, and None if the object is not in the image.
        """
        if self.projection is None:
            return [0.0] * 4, 0.0
        (rotation,) = matrices(boxes.quaternions[[row]])
        corners = (_CORNERS * boxes.sizes[row]) @ rotation.T + boxes.centers[row]
        corners = corners @ self.from_lidar[:3, :3].T + self.from_lidar[:3, 3]
        visible = _cut_at_camera(corners)
        if not len(visible):
            return None
        pixels = np.column_stack([visible, np.ones(len(visible))]) @ self.projection.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        lower = pixels.min(axis=0)
        upper = pixels.max(axis=0)
        limits = np.array(self.image_size) - 1.0
        low = lower.clip(0, limits)
        high = upper.clip(0, limits)
        inside = (high - low).prod()
        if inside <= 0:
            return None
        return [*low.tolist(), *high.tolist()], float(1 - inside / (upper - lower).prod())


def label_type(kind: str) -> str:
    """Return the name of an object type in KITTI labels, which contains no spaces.

    Examples
    --------
    >>> [label_type(kind) for kind in ("car", "Delivery van", "person")]
    ['Car', 'Delivery_van', 'Pedestrian']
    """
    return find_class(kind, _TYPES) or "_".join(kind.split()) or "Misc"


def _cut_at_camera(corners: Floats) -> Floats:
    """Return the corners of a box in front of the camera, with its edges cut at the camera."""
    depths = corners[:, 2]
    first, last = _EDGES.T
    crosses = (depths[first] < _MIN_DEPTH_M) != (depths[last] < _MIN_DEPTH_M)
    first, last = first[crosses], last[crosses]
    shares = (_MIN_DEPTH_M - depths[first]) / (depths[last] - depths[first])
    cuts = corners[first] + shares[:, None] * (corners[last] - corners[first])
    return np.concatenate([corners[depths >= _MIN_DEPTH_M], cuts])


def _projection(rows: Mapping[str, Floats]) -> Floats | None:
    """Return the projection of the left color camera, or None if it is a placeholder.

    Data sets without images have the identity as projection.
    """
    if "P2" not in rows or rows["P2"].size != 12:
        return None
    projection = rows["P2"].reshape(3, 4)
    return None if np.array_equal(projection[:, :3], np.eye(3)) else projection


def _square(row: Floats) -> Floats:
    return np.vstack([row.reshape(3, 4), [0, 0, 0, 1]])


def _image_size(image: Path) -> tuple[int, int]:
    if not image.exists():
        return IMAGE_SIZE
    from PIL import Image

    with Image.open(image) as opened:
        return opened.size
