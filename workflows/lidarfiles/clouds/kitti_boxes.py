"""Read the boxes of labeled objects in KITTI recordings.

KITTI tracking and exports have `label_02/NAME.txt` beside the folders of the sequences, and the
KITTI object benchmark has `label_2/FRAME.txt`, both with positions in the camera frame. A drive of
the raw data has `tracklet_labels.xml`, with positions in the frame of the lidar.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.io.input_files import read_input, read_input_text
from lidarsim.io.xmlfile import xml_root
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.transform import affine

from .recorded_boxes import RecordedBoxes, upright_pose

CALIBRATION_FILE = "calib.txt"
TRACKLETS_FILE = "tracklet_labels.xml"
# Rotation from a level sensor to a KITTI camera, whose axes point to the right, down and forward.
LEVEL_CAMERA = affine(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.zeros(3))
_IGNORED = "DontCare"
OBJECTS_FOLDER = "label_2"
_LABEL_FIELDS = 15  # of a line in `label_2`, without the score of a detection
_TRACK_FIELDS = 2  # preceding fields of a line in `label_02`: the frame and the track
_UPWARD = np.array([0.0, 0.0, 1.0])
_Row = tuple[int, int, str, Floats, Sequence[float]]


def read_boxes(folder: Path, files: Sequence[Path]) -> RecordedBoxes | None:
    """Read the boxes of a sequence, or return None if it has none.

    Parameters
    ----------
    folder
        Folder of the sequence.
    files
        Point files of the sweeps, whose names are the numbers of the frames.
    """
    numbers = {
        int(file.stem) if file.stem.isdecimal() else index: index
        for index, file in enumerate(files)
    }
    if (folder / TRACKLETS_FILE).exists():
        return RecordedBoxes.from_rows(_tracklets(folder / TRACKLETS_FILE, numbers))
    for root in folder.absolute().parents[:2]:
        labels = root / "label_02" / f"{folder.absolute().name}.txt"
        if labels.exists():
            return RecordedBoxes.from_rows(_tracks(labels, _camera(folder, root), numbers))
    if (folder / OBJECTS_FOLDER).is_dir():
        return RecordedBoxes.from_rows(_objects(folder, files))
    return None


def _camera(folder: Path, root: Path) -> Floats:
    """Return the transformation from the lidar to the rectified camera, of shape (4, 4)."""
    return _camera_of(folder / CALIBRATION_FILE, root / "calib" / f"{folder.absolute().name}.txt")


def _camera_of(*calibrations: Path) -> Floats:
    """Return the transformation in the first calibration file that exists and contains one."""
    for path in calibrations:
        if not path.exists():
            continue
        rows = read_calibration(path)
        for name in ("Tr", "Tr_velo_cam", "Tr_velo_to_cam"):
            if name not in rows:
                continue
            rectification = np.eye(4)
            for rectified in ("R_rect", "R0_rect"):
                if rectified in rows:
                    rectification[:3, :3] = rows[rectified].reshape(3, 3)
            return rectification @ np.vstack([rows[name].reshape(3, 4), [0, 0, 0, 1]])
    return LEVEL_CAMERA


def read_calibration(path: Path) -> dict[str, Floats]:
    """Read a calibration file with a name and 9 or 12 numbers per line.

    Raises LidarError if a line contains anything else than numbers after its name.
    """
    rows = {}
    for number, line in enumerate(read_input_text(path).splitlines(), 1):
        name, *values = line.replace(":", " ", 1).split() or [""]
        if not values:
            continue
        try:
            row = np.array([float(value) for value in values])
        except ValueError as error:
            raise LidarError(f"{path.name}, line {number}: {error}.") from error
        if len(row) in (9, 12):
            rows[name] = row
    return rows


def _tracks(path: Path, camera: Floats, numbers: dict[int, int]) -> Iterator[_Row]:
    """Yield the boxes in a file of KITTI tracking whose frames have a point file."""
    to_lidar = np.asarray(np.linalg.inv(camera), np.float64)
    for line_number, line in enumerate(read_input_text(path).splitlines(), 1):
        fields = line.split()
        if not fields or _IGNORED in fields[_TRACK_FIELDS : _TRACK_FIELDS + 1]:
            continue
        try:
            frame, number = map(int, fields[:_TRACK_FIELDS])
            kind, pose, size = _label(fields[_TRACK_FIELDS:], to_lidar)
        except ValueError as error:
            raise LidarError(
                f"{path.name}, line {line_number}: a label of KITTI tracking consists of "
                f"{_TRACK_FIELDS + _LABEL_FIELDS} fields. Repair this line, or remove the file."
            ) from error
        if frame not in numbers or number < 0:
            continue
        yield numbers[frame], number, kind, pose, size


def _objects(folder: Path, files: Sequence[Path]) -> Iterator[_Row]:
    """Yield the boxes in `label_2`, which has a file for each sweep.

    The labels do not identify objects, so each box belongs to a different object.
    """
    number = 0
    for sweep, file in enumerate(files):
        path = folder / OBJECTS_FOLDER / f"{file.stem}.txt"
        if not path.exists():
            continue
        camera = _camera_of(folder / "calib" / path.name, folder / CALIBRATION_FILE)
        to_lidar = np.asarray(np.linalg.inv(camera), np.float64)
        for line_number, line in enumerate(read_input_text(path).splitlines(), 1):
            fields = line.split()
            if not fields or fields[0] == _IGNORED:
                continue
            try:
                label = _label(fields, to_lidar)
            except ValueError as error:
                raise LidarError(
                    f"{OBJECTS_FOLDER}/{path.name}, line {line_number}: a label of KITTI consists "
                    f"of {_LABEL_FIELDS} fields. Repair this line, or remove the file."
                ) from error
            yield sweep, number, *label
            number += 1


def _label(fields: Sequence[str], to_lidar: Floats) -> tuple[str, Floats, Sequence[float]]:
    """Return the type, the pose and the size of a labeled box, given its fields.

    Raises ValueError if fields are missing or invalid.
    """
    height, width, length, x, y, z, rotation_y = map(float, fields[8:_LABEL_FIELDS])
    position = np.array([x, y - height / 2, z, 1.0])
    forward = to_lidar[:3, :3] @ [np.cos(rotation_y), 0.0, -np.sin(rotation_y)]
    upward = to_lidar[:3, :3] @ [0.0, -1.0, 0.0]
    pose = upright_pose((to_lidar @ position)[:3], forward, upward)
    return fields[0], pose, (length, width, height)


def _tracklets(path: Path, numbers: dict[int, int]) -> Iterator[_Row]:
    """Yield the boxes in the tracklets of a raw drive whose frames have a point file."""
    try:
        for number, item in enumerate(xml_root(read_input(path)).findall("tracklets/item")):
            size = [float(_text(item, name)) for name in ("l", "w", "h")]
            first = int(_text(item, "first_frame"))
            for step, pose in enumerate(item.findall("poses/item")):
                if first + step not in numbers:
                    continue
                position = np.array([float(_text(pose, name)) for name in ("tx", "ty", "tz")])
                yaw = float(_text(pose, "rz"))
                forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
                center = position + size[2] / 2 * _UPWARD
                placed = upright_pose(center, forward, _UPWARD)
                yield numbers[first + step], number, _text(item, "objectType"), placed, size
    except (ParseError, ValueError) as error:
        raise LidarError(
            f"{path.name} is not a valid file of KITTI tracklets: {error}. Repair the file, or "
            "remove it."
        ) from error


def _text(element: Element, name: str) -> str:
    text = element.findtext(name)
    if text is None:
        raise ValueError(f"an element has no <{name}>")
    return text.strip()
