"""Read and write KITTI folders with SemanticKITTI labels and bounding boxes of actors."""

from __future__ import annotations

import io
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import yaml
from numpy.typing import NDArray

from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import FLOW
from lidarsim.environment.extras import reading
from lidarsim.errors import LidarError
from lidarsim.io.input_files import read_input, read_input_text
from lidarsim.io.numbered_files import (
    frames_in_words,
    frames_without_file,
    rows_of_frames,
    skipped_frames,
    sort_by_number,
)
from lidarsim.io.time_units import seconds_of
from lidarsim.motion.rotations import matrices
from lidarsim.numerics.arrays import Floats, Floats32, Ints
from lidarsim.scene.files.float_rows import columns_by_name, read_float_columns
from lidarsim.scene.files.text_rows import RowReader
from lidarsim.sweeps.sweeps import Sweeps, make_identifiers
from lidarsim.words import join_names

from . import kitti_boxes
from .boxes import Boxes
from .job_reader import Entry, JobReader, PointColumns
from .multi_file_format import FileContent, MultiFileFormat, as_bytes, as_npy
from .point_field import OMITTED, PointField
from .recorded_boxes import RecordedBoxes
from .recording import FileRecording, Recording, RecordingInfo, sweep_from_columns
from .recording_ref import RecordingRef

_MATRIX_NUMBERS = [f"m{row}{column}" for row in range(3) for column in range(4)]
MAX_INSTANCES = 65_535
CALIBRATION_FILE = kitti_boxes.CALIBRATION_FILE
CLASS_FILE = "semantic-kitti.yaml"
_STAMP_FILE = "timestamps.txt"  # in the folder `_RAW_FOLDER` of a raw drive
_RAW_FOLDER = "velodyne_points"
# Rotation from a level sensor to a KITTI camera, whose axes point to the right, down and forward.
_CAMERA = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
# Upper limits of the truncation levels 0 and 1, as for easy and hard objects in the detection
# benchmark.
_TRUNCATIONS = (0.15, 0.5)
# Upper limits of the hidden fraction for the occlusion levels 0 and 1.
_OCCLUSIONS = (0.2, 0.6)
_UNKNOWN = 3
_FILE_PATTERN = (
    r"semantic-kitti\.yaml|(poses|label_02)/[^/]+\.txt|"
    r"sequences/[^/]+/((poses|times|calib)\.txt|(velodyne|labels|label_2)/\d+\.(bin|label|txt)|"
    r"flow/\d+/pc[12]\.npy)"
)


Row = TypeVar("Row", bound=np.generic)


class KITTI(MultiFileFormat):
    """A KITTI folder with one sequence per sensor.

    Sequences are named `sequences/00`, `sequences/01` and so on. In a data set, the first sensor of
    job 7 is `sequences/07`, and the other sensors are `sequences/07_NAME`. A sequence contains:

    - `velodyne/000000.bin`: float32 x, y and z in the sensor frame at the start of the sweep, and
      the reflectivity divided by 255, which ranges from 0 to 1.
    - `labels/000000.label`: uint32 with the instance (object number + 1) in the upper 16 bits and
      the class in the lower 16 bits.
    - `label_2/000000.txt`: boxes of the actors that have points, in surveys with actors.
    - `flow/000000/pc1.npy` and `pc2.npy`: scene flow, if the cloud has the columns `flow_x`,
      `flow_y` and `flow_z` (see `flow_arrays`).
    - `poses.txt`: 3 x 4 matrices relative to the first pose.
    - `times.txt`: times in seconds.
    - `calib.txt`: calibration.

    `label_02/00.txt` contains the boxes of all sweeps in the layout of KITTI tracking. The track
    IDs are the instance numbers.

    Poses and boxes are in the frame of a virtual KITTI camera at the position of the sensor. `Tr`
    in the calibration transforms points to this frame. The camera is level on average, even if the
    sensor is tilted, because KITTI only rotates boxes about the vertical axis of the camera.
    KITTI's own tools expect poses in `poses/00.txt`, so they are stored there, too.

    Behley et al., SemanticKITTI, 2019; Geiger et al., 2012; Gu et al., HPLFlowNet, 2019.
    """

    title = "KITTI"
    by_sweep = True
    frame = "sweep"
    fields = (
        PointField("instance of the label", ("object",)),
        PointField("reflectance", ("reflectivity",)),
        PointField("class of the label", ("class",)),
        PointField("flow", FLOW, OMITTED, on_request=True),
    )
    other_columns = False
    actor_boxes = True
    file_pattern = _FILE_PATTERN
    separate_sweeps = True
    raw_sweeps = True
    for_scenes = True

    def __init__(self, cloud: CloudLike, sweeps: Sweeps, entry: Entry | None = None) -> None:
        if len(sweeps.objects) + len(sweeps.actors) > MAX_INSTANCES:
            raise LidarError(
                f"KITTI labels support at most {MAX_INSTANCES:,} objects. Write another format."
            )
        super().__init__(cloud, sweeps, entry)
        self.names = sequence_names(sweeps, entry)
        self.sequences = [f"sequences/{name}" for name in self.names]
        kinds = ("velodyne", "labels", *(["label_2"] if sweeps.actors else []))
        self.folders = [f"{folder}/{kind}" for folder in self.sequences for kind in kinds]
        if {*FLOW} <= {column.name for column in cloud.table}:
            self.folders += [self._flow_folder(number) for number in range(len(sweeps))]
        self.cameras = [_camera(sweeps, sensor) for sensor in range(len(sweeps.sensors))]

    def files(self, number: int, points: Cloud) -> tuple[dict[str, FileContent], Boxes | None]:
        """Return the files of a sweep, and the sweep's boxes if there are actors."""
        sweeps = self.sweeps
        folder = self.sequences[sweeps.sensor[number]]
        name = f"{sweeps.numbers[number]:06}"
        rows = np.empty((len(points), 4), "<f4")
        rows[:, :3] = sweeps.compensate_motion(number, points)
        rows[:, 3] = kitti_intensity(points)
        labels = (points["object"].astype("<u4") + 1) << 16 | points["class"]
        files: dict[str, FileContent] = {
            f"{folder}/velodyne/{name}.bin": as_bytes(rows),
            f"{folder}/labels/{name}.label": as_bytes(labels),
        }
        if {*FLOW} <= points.columns.keys():
            camera = self.cameras[sweeps.sensor[number]]
            columns = sweeps.columns_compensated(number, points)
            flow = np.stack([columns[axis] for axis in FLOW], axis=1)
            arrays = flow_arrays(rows[:, :3], flow, camera)
            files |= {
                f"{self._flow_folder(number)}/{key}.npy": as_npy(array)
                for key, array in arrays.items()
            }
        if not sweeps.actors:
            return files, None
        boxes = Boxes.from_points(sweeps, number, points)
        camera = self.cameras[sweeps.sensor[number]]
        labels_of_actors = _labels(sweeps, number, boxes, camera)
        lines = (
            f"{label.kind} {label.truncation:.2f} {label.occlusion} {label.values}\n"
            for label in labels_of_actors
        )
        files[f"{folder}/label_2/{name}.txt"] = "".join(lines).encode()
        return files, boxes

    def _flow_folder(self, number: int) -> str:
        """Return the folder with the scene flow of a sweep."""
        sweeps = self.sweeps
        return f"{self.sequences[sweeps.sensor[number]]}/flow/{sweeps.numbers[number]:06}"

    def shared_files(self, boxes: Sequence[Boxes | None]) -> dict[str, bytes]:
        """Return the files with poses, times, calibrations and tracks."""
        sweeps = self.sweeps
        files: dict[str, bytes] = {}
        for sensor, (folder, camera) in enumerate(zip(self.sequences, self.cameras, strict=True)):
            sweep_mask = sweeps.sensor == sensor
            rotations = matrices(sweeps.pose.quaternions[sweep_mask])
            positions = sweeps.pose.positions[sweep_mask]
            first = camera @ rotations[0].T
            rows = np.concatenate(
                [first @ rotations @ camera.T, ((positions - positions[0]) @ first.T)[..., None]],
                axis=2,
            )
            poses = _table(rows.reshape(-1, 12))
            files |= {f"{folder}/poses.txt": poses, f"poses/{self.names[sensor]}.txt": poses}
            files[f"{folder}/times.txt"] = _table(sweeps.begins_ns[sweep_mask] / 1e9)
            lines = [f"P{number}: {_row(np.eye(3))}\n" for number in range(4)]
            files[f"{folder}/{CALIBRATION_FILE}"] = "".join(
                [*lines, f"Tr: {_row(camera)}\n"]
            ).encode()
            if sweeps.actors:
                tracks = self._tracks(np.flatnonzero(sweep_mask).tolist(), boxes)
                files[f"label_02/{self.names[sensor]}.txt"] = tracks
        if sweeps.classes and self.entry is None:  # otherwise, all jobs share a file
            files |= self.class_files(sweeps.classes)
        return files

    def _tracks(self, numbers: Sequence[int], boxes: Sequence[Boxes | None]) -> bytes:
        """Format a sensor's boxes in all sweeps for KITTI tracking."""
        sweeps = self.sweeps
        lines = []
        for frame, number in enumerate(numbers):
            boxes_of_sweep = boxes[number]
            assert boxes_of_sweep is not None  # there are actors
            camera = self.cameras[sweeps.sensor[number]]
            for label in _labels(sweeps, number, boxes_of_sweep, camera):
                instance = len(sweeps.objects) + label.actor + 1
                level = bisect_left(_TRUNCATIONS, label.truncation)
                lines.append(
                    f"{frame} {instance} {label.kind} {level} {label.occlusion} {label.values}\n"
                )
        return "".join(lines).encode()

    @classmethod
    def sweep_files(cls, job: JobReader, sweep: int) -> list[str]:
        """Return the names of the point file and the label file."""
        names = job.get_or_compute("sequences", lambda: sequence_names(job.sweeps, job.entry))
        folder = f"sequences/{names[job.sweeps.sensor[sweep]]}"
        number = f"{job.sweeps.numbers[sweep]:06}"
        return [f"{folder}/velodyne/{number}.bin", f"{folder}/labels/{number}.label"]

    @classmethod
    def read_sweep(cls, job: JobReader, sweep: int) -> PointColumns:
        """Read points with intensity (the reflectivity from 0 to 1), class and object."""
        file, labels_file = cls.sweep_files(job, sweep)
        rows = job.read_rows(file, np.dtype("<f4")).reshape(-1, 4)
        labels = job.read_rows(labels_file, np.dtype("<u4"), len(rows))
        instances = (labels >> 16).view("<i4")
        instances -= 1
        classes = labels.view("<u2")[::2]
        return rows[:, :3], {"intensity": rows[:, 3], "class": classes, "object": instances}

    @classmethod
    def open(cls, ref: RecordingRef) -> Recording:
        """Open a KITTI or nuScenes .bin file, or a KITTI or SemanticKITTI sequence."""
        path = ref.path
        if not path.is_dir():
            return _KittiRecording(ref.info(), [path], path.parent.parent / "labels")
        name, folders = ref.choose_sensor(sequence_folders(path))
        with reading(ref.name):
            return _open_sequence(ref, name, *folders)

    @classmethod
    def class_files(cls, classes: Mapping[int, str]) -> dict[str, bytes]:
        """Return the class file for semantic-kitti-api, with names and BGR colors."""
        labels = {0: "unlabeled", **classes}
        colors = {number: [number * step % 256 for step in (37, 91, 151)] for number in labels}
        content = {"labels": labels, "color_map": colors}
        return {CLASS_FILE: yaml.safe_dump(content, allow_unicode=True).encode()}


def kitti_intensity(points: Cloud) -> Floats32:
    """Return the reflectivity of points, from 0 to 1. KITTI stores it as intensity."""
    return np.asarray(points["reflectivity"] / np.float32(255), np.float32)


def flow_arrays(points: Floats32, flow: Floats32, camera: Floats) -> dict[str, Floats32]:
    """Return the scene flow of a sweep in the layout that HPLFlowNet uses for KITTI.

    Row i of `pc1` is a point, and row i of `pc2` is the same point in the next sweep, each in the
    frame of its own sweep, whose axes point to the left, up and forward. Points whose flow is
    unknown are omitted. Both arrays have shape (k, 3).

    Parameters
    ----------
    points, flow
        Points of the sweep and their flow in the sensor frame, each (n, 3) in meters.
    camera
        Rotation from the sensor frame to the camera frame, whose axes point to the right, down and
        forward. Shape (3, 3).
    """
    known = np.isfinite(flow).all(axis=1)
    axes = (camera * np.array([[-1.0], [-1], [1]])).T
    starts = points[known].astype(np.float64)
    return {
        "pc1": (starts @ axes).astype(np.float32),
        "pc2": ((starts + flow[known]) @ axes).astype(np.float32),
    }


def first_sequence(job: int | None) -> str:
    """Return the name of the first sensor's sequence.

    `job` is the number of a job in a data set, or None for a single survey.
    """
    return f"{job or 0:02}"


def sequence_names(sweeps: Sweeps, entry: Entry | None) -> list[str]:
    """Return the name of each sensor's sequence."""
    if entry is None:
        return [f"{sensor:02}" for sensor in range(len(sweeps.sensors))]
    first = first_sequence(entry.number)
    names = make_identifiers(name or "lidar" for name in sweeps.sensors)[1:]
    return [first, *(f"{first}_{name}" for name in names)]


def _table(matrix: Floats) -> bytes:
    memory = io.BytesIO()
    np.savetxt(memory, matrix, "%.9e")
    return memory.getvalue()


def _row(rotation: Floats) -> str:
    """Format a rotation as a 3 x 4 matrix without translation."""
    return " ".join(f"{value:.9e}" for value in np.column_stack([rotation, np.zeros(3)]).ravel())


def _camera(sweeps: Sweeps, sensor: int) -> Floats:
    """Return the rotation from the sensor frame to a level camera frame with the same heading."""
    # The z axis of the world in the sensor frame, summed over all sweeps.
    up = matrices(sweeps.pose.quaternions[sweeps.sensor == sensor])[:, 2].sum(axis=0)
    leftward = np.cross(up, [1, 0, 0])
    if not leftward.any():  # the sensor looks straight up or down
        return _CAMERA
    axes = np.stack([np.cross(leftward, up), leftward, up])
    return np.asarray(_CAMERA @ (axes / np.linalg.norm(axes, axis=1, keepdims=True)))


class _Label(NamedTuple):
    """Label of an actor that has points."""

    actor: int  # number of the actor
    kind: str
    truncation: float  # from 0 to 1
    occlusion: int  # 0 fully visible, 1 partly occluded, 2 largely occluded, 3 unknown
    values: str  # remaining values of a line


def _labels(sweeps: Sweeps, sweep: int, boxes: Boxes, camera: Floats) -> Iterator[_Label]:
    """Yield the label of each actor that has points.

    There are no images, so the image box is zero. The position is the center of the bottom face.
    Boxes are only rotated about the y axis of the camera.
    """
    rotation = camera @ matrices(sweeps.pose.quaternions[sweep, None])[0].T
    forward = (rotation @ matrices(boxes.quaternions))[:, :, 0]  # headings of the actors
    positions = sweeps.pose.to_body_frame(sweep, boxes.centers) @ camera.T
    positions[:, 1] += boxes.sizes[:, 2] / 2
    rotation_y = np.arctan2(-forward[:, 2], forward[:, 0])
    alpha = rotation_y - np.arctan2(positions[:, 0], positions[:, 2])
    alpha = np.angle(np.exp(1j * alpha))  # between -pi and pi
    image_boxes = np.zeros((len(alpha), 4))
    sizes = boxes.sizes[:, ::-1]  # height, width and length
    rows = np.column_stack([alpha, image_boxes, sizes, positions, rotation_y])
    for actor in np.flatnonzero(boxes.present & (boxes.points > 0)).tolist():
        values = " ".join(f"{value:.4f}" for value in rows[actor])
        truncation = 0.0
        occlusion = _UNKNOWN
        if boxes.visibility is not None:
            truncation = float(boxes.visibility.truncation[actor])
            hidden = 1 - float(boxes.visibility.visible_fraction[actor])
            occlusion = _UNKNOWN if np.isnan(hidden) else bisect_left(_OCCLUSIONS, hidden)
        yield _Label(actor, sweeps.actor_types[actor], truncation, occlusion, values)


# -- reading ---------------------------------------------------------------------------------


def sequence_folders(folder: Path) -> dict[str, tuple[Path, Path]]:
    """Find the sequences in a folder.

    The folder can also be a single sequence, or contain .bin files.

    Returns
    -------
    dict
        The folder of each sequence and its folder with point files, keyed by the name of the
        sequence. The name of a single sequence is empty.
    """
    sequences = sort_by_number(p for p in folder.glob("sequences/*") if (p / "velodyne").is_dir())
    if sequences:
        return {sequence.name: (sequence, sequence / "velodyne") for sequence in sequences}
    for inner in ("velodyne", "velodyne_points/data", "."):
        if any((folder / inner).glob("*.bin")):
            return {"": (folder, folder / inner)}
    return {}


def point_files(folder: Path) -> list[Path]:
    """Return the point files of a sequence in the order of its sweeps."""
    return sort_by_number(folder.glob("*.bin"))


class _KittiRecording(FileRecording):
    """Point files of a sequence.

    Parameters
    ----------
    info
        What is known about the sequence.
    files
        Point files in the order of the sweeps.
    labels
        Folder with the label files, which may not exist.
    folder
        Folder of the sequence, or None for a single file.
    poses
        Poses of the sweeps, of shape (n, 4, 4), or None.
    times_ns
        Timestamps of the sweeps in nanoseconds, of shape (n,), or None.
    """

    def __init__(
        self,
        info: RecordingInfo,
        files: list[Path],
        labels: Path,
        folder: Path | None = None,
        poses: Floats | None = None,
        times_ns: Ints | None = None,
    ) -> None:
        super().__init__(info, files)
        self._labels = labels
        self._folder = folder
        self._sweep_poses = poses
        self._times_ns = times_ns

    def load(self, number: int) -> Sweep:
        file = self.paths[number]
        pose = None if self._sweep_poses is None else self._sweep_poses[number]
        time_ns = None if self._times_ns is None else int(self._times_ns[number])
        return _read_sweep(file, self._labels / f"{file.stem}.label", pose=pose, time_ns=time_ns)

    def load_stamps(self) -> Ints | None:
        return self._times_ns

    def load_boxes(self) -> RecordedBoxes | None:
        return None if self._folder is None else kitti_boxes.read_boxes(self._folder, self.paths)

    def load_classes(self) -> dict[int, str]:
        return {} if self._folder is None else _class_names(self._folder)


def _open_sequence(ref: RecordingRef, name: str, folder: Path, points: Path) -> Recording:
    """Open a folder of sweeps, with labels, poses and times if they exist."""
    files = point_files(points)
    calibration = folder / CALIBRATION_FILE
    tables = _FrameTables(files)
    poses = tables.read_poses(folder)
    times_ns = tables.read_times_ns(folder, points)
    notes = tables.notes
    if poses is not None and not calibration.exists():
        notes.append(f"has no {CALIBRATION_FILE}, so its poses are assumed to be lidar poses")
    if times_ns is None and (skipped := skipped_frames(files)):
        notes.append(
            f"has no point file for {frames_in_words(skipped)} and no times, so its sweeps are "
            "treated as evenly spaced"
        )
    if folder.absolute() == points.absolute():
        notes += _notes_on_tables(folder.absolute())
    info = ref.info(
        sensor=name,
        sequence=name,
        calibration=calibration.absolute(),
        notes=ref.prefix_notes(notes),
    )
    return _KittiRecording(info, files, folder / "labels", folder, poses, times_ns)


@dataclass
class _FrameTables:
    """Tables of a sequence, with a row for each frame, and notes about them."""

    files: list[Path]  # point files
    notes: list[str] = field(default_factory=list)

    def read_poses(self, sequence: Path) -> Floats | None:
        """Return the lidar poses of the sweeps, or None if there are none.

        In the odometry benchmark, the poses of `sequences/00` are in `poses/00.txt`.
        """
        names = ["poses.txt"]
        if sequence.absolute().parent.name == "sequences":
            names.append(f"../../poses/{sequence.absolute().name}.txt")
        for name in names:
            if (sequence / name).exists():
                rows = self._of_files(_matrices(sequence / name), name.removeprefix("../../"))
                return lidar_poses(rows, sequence / CALIBRATION_FILE)
        return None

    def read_times_ns(self, sequence: Path, points: Path) -> Ints | None:
        """Return the timestamps of the sweeps in nanoseconds, or None if there are none."""
        if (sequence / "times.txt").exists():
            seconds = np.loadtxt(sequence / "times.txt", ndmin=1)
            times_ns = 1e9 * seconds_of(
                seconds, None, advice=("specify the times in times.txt in seconds")
            )
            return self._of_files(np.rint(times_ns).astype(np.int64), "times.txt")
        stamps = points.absolute().parent / _STAMP_FILE
        if stamps.parent.name != _RAW_FOLDER or not stamps.exists():
            return None
        times = self._of_files(_timestamps(stamps), _STAMP_FILE)
        if np.isnat(times).any():
            file = self.files[int(np.isnat(times).argmax())]
            raise ValueError(
                f"{_STAMP_FILE} has no time for {file.name}. Add it, or remove the file"
            )
        return times.astype(np.int64)

    def _of_files(self, rows: NDArray[Row], table: str) -> NDArray[Row]:
        """Return the rows that belong to point files. If there are other rows, add a note."""
        indices = rows_of_frames(self.files, len(rows), table, "point files")
        if surplus := frames_without_file(self.files, len(rows)):
            self.notes.append(f"has no point file for {frames_in_words(surplus)} in {table}")
        return rows[indices]


def _notes_on_tables(points: Path) -> list[str]:
    """Return notes on tables that are not used, because only a folder with points is read."""
    names = [name for name in ("poses.txt", "times.txt") if (points.parent / name).exists()]
    if points.name == "velodyne" and names:
        return [
            f"is read without {join_names(names)} in its parent folder. Specify the parent folder "
            "to use them"
        ]
    tables = next(points.parent.parent.glob("v1.0-*/sample_data.json"), None)
    if points.parent.name in ("samples", "sweeps") and tables is not None:
        return [
            f"is read without the poses and times in the tables of nuScenes. Specify the folder "
            f"{tables.parents[1]} to use them"
        ]
    return []


def _timestamps(path: Path) -> NDArray[np.datetime64]:
    """Read the timestamps of a raw drive with a resolution of 1 ns.

    The file has a row for each frame, also for frames that were not recorded. Rows without a time
    are NaT.

    Raises ValueError with the line number if a line is invalid.
    """
    lines = read_input_text(path).rstrip().splitlines()
    times = np.full(len(lines), np.datetime64("NaT", "ns"))
    for row, line in enumerate(lines):
        if not line.strip():
            continue
        try:
            times[row] = np.datetime64(line.strip(), "ns")
        except ValueError as error:
            raise ValueError(
                f"{path.name}: line {row + 1} is not a time such as 2011-09-26 13:02:25.594360375"
            ) from error
    return times


def _class_names(sequence: Path) -> dict[int, str]:
    """Read the names of classes from the class file of a data set, if there is one."""
    for folder in (sequence, *sequence.absolute().parents[:2]):
        if (folder / CLASS_FILE).exists():
            content = yaml.safe_load(read_input_text(folder / CLASS_FILE))
            labels = content.get("labels") if isinstance(content, dict) else None
            if not isinstance(labels, dict):
                raise ValueError(f"{CLASS_FILE} has no section `labels` with the names of classes")
            return {int(number): str(label) for number, label in labels.items()}
    return {}


def lidar_poses(rows: Floats, calibration: Path) -> Floats:
    """Convert the matrices in `poses.txt` to lidar poses.

    The matrices have shape (n, 3, 4), and the poses have shape (n, 4, 4). The matrices are camera
    poses, and the file `calibration` contains the transformation from the lidar to the camera. If
    this file does not exist, the matrices are assumed to be lidar poses.
    """
    camera = _calibration(calibration)
    with np.errstate(invalid="ignore"):  # poses that are not finite are refused with their sweep
        return np.array([np.linalg.inv(camera) @ _square(row) @ camera for row in rows])


def _matrices(path: Path) -> Floats:
    """Read a file with one 3 x 4 matrix per line.

    Raises ValueError with the line number if a line is invalid.
    """
    reader = RowReader(_MATRIX_NUMBERS, range(len(_MATRIX_NUMBERS)))
    try:
        return reader.read(read_input_text(path).splitlines(), 1).reshape(-1, 3, 4)
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from error


def _calibration(path: Path) -> Floats:
    """Read the transformation matrix from the lidar to the camera.

    Returns the identity if the file does not exist.
    """
    if not path.exists():
        return np.eye(4)
    for number, line in enumerate(read_input_text(path).splitlines(), 1):
        key, _, values = line.partition(":")
        if key == "Tr":
            reader = RowReader(_MATRIX_NUMBERS, range(len(_MATRIX_NUMBERS)))
            try:
                matrix = _square(reader.read([values], number).reshape(3, 4))
            except ValueError as error:
                raise ValueError(f"{path.name}: {error}") from error
            if not np.isfinite(matrix).all():
                raise ValueError(f"{path.name}: the matrix in line {number} is not finite")
            return matrix
    raise ValueError(
        f"{path.name} has no `Tr:` line, which transforms lidar coordinates to the camera frame "
        f"of the poses. Add this line, or remove {path.name} if the poses are lidar poses."
    )


def _square(matrix_rows: Floats) -> Floats:
    """Extend a 3 x 4 matrix to a 4 x 4 matrix."""
    return np.vstack([matrix_rows, [0, 0, 0, 1]])


def _read_sweep(path: Path, labels: Path, **fields: Any) -> Sweep:
    """Read a sweep, including classes and objects if the label file exists."""
    sweep = sweep_from_columns(read_float_columns(path, columns_by_name(path)), **fields)
    columns = dict(sweep.columns)
    if labels.exists():
        numbers = np.frombuffer(read_input(labels), "<u4")
        if len(numbers) != len(sweep):
            raise ValueError(f"{labels.name} has {len(numbers)} labels for {len(sweep)} points")
        columns["class"] = (numbers & 0xFFFF).astype(np.uint16)
        columns["object"] = (numbers >> 16).astype(np.int32) - 1
    return sweep.replace(columns=columns)
