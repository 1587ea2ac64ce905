"""Reads single sweeps, or parts of clouds, of formats that hold them in many files, or with poses.

E57, Parquet, KITTI, nuScenes, WebDataset and range images: those that lidarpool writes, and those
of other programs with the same layout.
"""

from __future__ import annotations

import json
import tarfile
from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarsim.base.allowance import Allowance
from lidarsim.base.archives import open_archive, read_npy
from lidarsim.base.arrays import AnyArray, Floats
from lidarsim.base.errors import LidarError
from lidarsim.base.extras import need
from lidarsim.base.input_files import input_size, read_input, read_input_text
from lidarsim.base.time_units import seconds_of
from lidarsim.base.words import natural
from lidarsim.columns.table import TABLE
from lidarsim.scene.files.e57_system import e57_system
from lidarsim.scene.files.float_rows import NUSCENES, columns_by_name, read_float_columns
from lidarsim.scene.files.stated_system import check_metric_format
from lidarsim.scene.files.text_rows import RowReader
from lidarsim.scene.transform import affine
from lidarsim.sensor.trajectory import matrices

from ..export.images import points_of_images

Columns = Mapping[str, AnyArray]
# Positions (n, 3), columns (n,), and the sensor's pose in the world (4, 4); None if unknown.
Read = tuple[AnyArray, Columns, Floats | None]

_MATRIX_NUMBERS = [f"m{row}{column}" for row in range(3) for column in range(4)]  # of KITTI
_THIN = "thin it first"
_E57_COLUMNS = {
    "colorRed": "red",
    "colorGreen": "green",
    "colorBlue": "blue",
    "rowIndex": "row",
    "columnIndex": "column",
}


class SweepFiles(NamedTuple):
    """Sweeps of a sensor, or parts of a cloud."""

    sweeps: int  # or parts
    read: Callable[[int], Read]
    times_ns: Floats | None = None  # (sweeps,): start of each sweep; None if unknown
    point_count: int | None = None  # of a cloud in parts; None of sweeps
    sequence: str = ""  # name of a drive with coordinates of its own; "" for the only one
    notes: tuple[str, ...] = ()  # clauses that follow the name of the recording
    epsg: int | None = None  # of the system that the file states, if that is in metres


def open_e57(path: Path, name: str) -> SweepFiles:
    """Open the scans of an E57, each in the axes of its scanner, with its pose."""
    need("pye57", "e57", f"{name} is read")
    size = input_size(path)
    file = import_module("pye57").E57(str(path))
    # A column of equal values takes no bytes, whatever the number of points.
    total = Allowance(size, _THIN, in_parts=True)
    for number in range(file.scan_count):
        total.take(_bytes_of_scan(file.get_header(number)))

    def read(number: int) -> tuple[AnyArray, Columns, Floats]:
        header = file.get_header(number)
        Allowance(size, _THIN).take(_bytes_of_scan(header))
        data = file.read_scan_raw(number, ignore_unsupported_fields=True)
        if "cartesianX" in data:
            points = np.stack([data.pop(f"cartesian{axis}") for axis in "XYZ"], axis=1)
        else:
            points = _from_spherical(data)
        invalid = data.pop("cartesianInvalidState", data.pop("sphericalInvalidState", None))
        valid = np.ones(len(points), bool) if invalid is None else np.asarray(invalid) == 0
        columns = {
            _E57_COLUMNS.get(key, key): np.asarray(values)[valid] for key, values in data.items()
        }
        pose = np.eye(4)
        if header.has_pose():
            pose = affine(header.rotation_matrix, header.translation)
        return points[valid], columns, pose

    system = e57_system(file)
    if system is None or not file.scan_count:
        return SweepFiles(file.scan_count, read)
    points, _, pose = read(0)
    positions = points @ pose[:3, :3].T + pose[:3, 3]
    notes = tuple(check_metric_format(system, positions))
    epsg = system.epsg if system.horizontal_m == 1.0 else None  # else points are in no such system
    return SweepFiles(file.scan_count, read, notes=notes, epsg=epsg)


def _bytes_of_scan(header: Any) -> int:
    """Return the memory of the columns of a scan of an E57, of 8 bytes a number."""
    return 8 * int(header.point_count) * len(header.point_fields)


def _from_spherical(data: dict[str, AnyArray]) -> Floats:
    """Return positions (n, 3) of the spherical coordinates of an E57, which are taken out."""
    ranges, azimuth, elevation = (
        data.pop(f"spherical{part}") for part in ("Range", "Azimuth", "Elevation")
    )
    across = ranges * np.cos(elevation)
    return np.stack(
        [across * np.cos(azimuth), across * np.sin(azimuth), ranges * np.sin(elevation)], axis=1
    )


def open_parquet(path: Path, name: str) -> SweepFiles:
    """Open the points of a .parquet file, or a folder of them, in their groups of rows.

    Only columns of numbers are read: the memory of others is not known before.
    """
    need("pyarrow", "parquet", f"{name} is read")
    from ..export.parquet_groups import (  # imports pyarrow
        check_groups,
        group_allowance,
        number_columns,
        read_group,
    )

    if path.is_file():
        input_size(path)
    dataset = import_module("pyarrow.dataset").dataset(str(path), format="parquet")
    groups = []
    files = []  # of each group: names of columns of numbers, and size in bytes
    unread = set[str]()  # names of columns
    for file in dataset.get_fragments():
        columns = number_columns(file.physical_schema)
        unread |= set(file.physical_schema.names) - set(columns)
        size = input_size(file.path)
        of_file = file.split_by_row_group()
        check_groups(of_file, columns, size)
        groups += of_file
        files += len(of_file) * [(columns, size)]
    if axes := sorted(unread.intersection("xyz")):
        raise ValueError(f"its {', '.join(axes)} are no numbers")
    names = {column.in_files: column.name for column in TABLE.values()}

    def read(number: int) -> Read:
        number_names, size = files[number]
        rows = read_group(groups[number], number_names, group_allowance(size))
        columns = {
            names.get(column, column): rows[column].to_numpy() for column in rows.column_names
        }
        return _positions(columns), columns, None

    notes = []
    if unread:
        notes.append(f"has columns that are no numbers: {', '.join(sorted(unread))}")
    return SweepFiles(len(groups), read, point_count=dataset.count_rows(), notes=tuple(notes))


def open_kitti(folder: Path) -> dict[str, SweepFiles]:
    """Open the sequences of KITTI odometry or SemanticKITTI, a sequence, or its .bin files.

    Empty if the folder has none of these.
    """
    sequences = sorted(p for p in folder.glob("sequences/*") if (p / "velodyne").is_dir())
    if sequences:
        return {
            sequence.name: _kitti_sequence(sequence, "velodyne")._replace(sequence=sequence.name)
            for sequence in sequences
        }
    for inner in ("velodyne", "velodyne_points/data", "."):
        if any((folder / inner).glob("*.bin")):
            return {"": _kitti_sequence(folder, inner)}
    return {}


def open_kitti_file(path: Path) -> SweepFiles:
    """Open a .bin of KITTI, a sweep."""
    labels = path.parent.parent / "labels" / f"{path.stem}.label"
    return SweepFiles(1, lambda _: _kitti_sweep(path, labels, None))


def _kitti_sequence(folder: Path, inner: str) -> SweepFiles:
    """Open the sweeps of a folder, with its labels, poses and times if it has these."""
    files = sorted((folder / inner).glob("*.bin"), key=lambda file: natural(file.name))
    poses: Floats | None = None
    if (folder / "poses.txt").exists():
        rows = _kitti_matrices(folder / "poses.txt")
        camera = _kitti_calibration(folder / "calib.txt")
        poses = np.array([np.linalg.inv(camera) @ _square(row) @ camera for row in rows])
    times_ns: Floats | None = None
    if (folder / "times.txt").exists():
        seconds = np.loadtxt(folder / "times.txt", ndmin=1)
        times_ns = 1e9 * seconds_of(seconds, None, advice="write seconds into times.txt")
    for kind, rows_of_kind in (("poses", poses), ("times", times_ns)):
        if rows_of_kind is not None and len(rows_of_kind) < len(files):
            raise ValueError(
                f"{kind}.txt has {len(rows_of_kind)} rows for {len(files)} files of points"
            )

    def read(number: int) -> Read:
        file = files[number]
        pose = None if poses is None else poses[number]
        return _kitti_sweep(file, folder / "labels" / f"{file.stem}.label", pose)

    return SweepFiles(len(files), read, None if times_ns is None else times_ns[: len(files)])


def _kitti_matrices(path: Path) -> Floats:
    """Return the matrices (n, 3, 4) of a file, one in each line; ValueError names a wrong line."""
    reader = RowReader(_MATRIX_NUMBERS, range(len(_MATRIX_NUMBERS)))
    try:
        return reader.read(read_input_text(path).splitlines(), 1).reshape(-1, 3, 4)
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from error


def _kitti_calibration(path: Path) -> Floats:
    """Return the matrix (4, 4) from the lidar to the camera; the identity without a file."""
    if path.exists():
        for number, line in enumerate(read_input_text(path).splitlines(), 1):
            key, _, values = line.partition(":")
            if key == "Tr":
                reader = RowReader(_MATRIX_NUMBERS, range(len(_MATRIX_NUMBERS)))
                try:
                    return _square(reader.read([values], number).reshape(3, 4))
                except ValueError as error:
                    raise ValueError(f"{path.name}: {error}") from error
    return np.eye(4)


def _square(rows: Floats) -> Floats:
    """Return a matrix (3, 4) as (4, 4)."""
    return np.vstack([rows, [0, 0, 0, 1]])


def _kitti_sweep(path: Path, labels: Path, pose: Floats | None) -> Read:
    """Read a sweep, with its classes and objects if there is a file of labels."""
    columns = read_float_columns(path, columns_by_name(path))
    positions = _positions(columns)
    if labels.exists():
        numbers = np.frombuffer(read_input(labels), "<u4")
        if len(numbers) != len(positions):
            raise ValueError(f"{labels.name} has {len(numbers)} labels for {len(positions)} points")
        columns["class"] = (numbers & 0xFFFF).astype(np.uint16)
        columns["object"] = (numbers >> 16).astype(np.int32) - 1
    return positions, columns, pose


def nuscenes_tables(folder: Path) -> Path | None:
    """Return the folder of tables of a nuScenes data set, ``v1.0-…``, or None."""
    return next((file.parent for file in sorted(folder.glob("v1.0-*/sample_data.json"))), None)


def open_nuscenes(folder: Path, tables: Path) -> dict[str, SweepFiles]:
    """Open the lidars of a nuScenes data set, {channel: sweeps in order of time}.

    The names of channels begin with the name of their scene if there are several scenes.
    """

    def table(name: str) -> dict[str, dict[str, Any]]:
        return {row["token"]: row for row in json.loads(read_input(tables / f"{name}.json"))}

    sensors = table("sensor")
    calibrated = table("calibrated_sensor")
    poses = table("ego_pose")
    labels: dict[str, str] = {}  # {token of a sweep: file of its classes}
    if (tables / "lidarseg.json").exists():
        labels = {row["sample_data_token"]: row["filename"] for row in table("lidarseg").values()}
    scenes = table("scene")
    scene_of_sample = {token: row["scene_token"] for token, row in table("sample").items()}
    rows_of_channel: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in table("sample_data").values():
        sensor = sensors[calibrated[row["calibrated_sensor_token"]]["sensor_token"]]
        if sensor["modality"] == "lidar":
            scene = scenes[scene_of_sample[row["sample_token"]]]["name"]
            rows_of_channel.setdefault((scene, sensor["channel"]), []).append(row)

    def pose_of(row: Mapping[str, Any]) -> Floats:
        w, x, y, z = row["rotation"]
        return affine(matrices(np.array([[x, y, z, w]]))[0], np.array(row["translation"]))

    def sweeps_of(rows: list[dict[str, Any]]) -> SweepFiles:
        rows.sort(key=lambda row: row["timestamp"])

        def read(number: int) -> Read:
            row = rows[number]
            columns = read_float_columns(folder / row["filename"], NUSCENES)
            positions = _positions(columns)
            if row["token"] in labels:
                columns["class"] = np.frombuffer(read_input(folder / labels[row["token"]]), "u1")
            calibration = pose_of(calibrated[row["calibrated_sensor_token"]])
            return positions, columns, pose_of(poses[row["ego_pose_token"]]) @ calibration

        return SweepFiles(len(rows), read, 1e3 * np.array([row["timestamp"] for row in rows]))

    if len(scenes) == 1:
        return {channel: sweeps_of(rows) for (_, channel), rows in sorted(rows_of_channel.items())}
    return {
        f"{scene} {channel}": sweeps_of(rows)._replace(sequence=scene)
        for (scene, channel), rows in sorted(rows_of_channel.items())
    }


def open_webdataset(files: list[Path]) -> dict[str, SweepFiles]:
    """Open the samples of tar files, {sensor: sweeps}: ``KEY.points.npy``, ``KEY.json``, ….

    LidarError if no sample has points.
    """
    keys_of_sensor: dict[str, list[tuple[float, Path, dict[str, tuple[int, int]]]]] = {}
    for path in files:
        for members in _samples(path).values():
            if "points.npy" not in members:
                continue
            description = json.loads(_slice(path, *members["json"])) if "json" in members else {}
            sample = (float(description.get("time_ns", 0)), path, members)
            keys_of_sensor.setdefault(description.get("sensor", ""), []).append(sample)
    if not keys_of_sensor:
        raise LidarError(
            f"{files[0].name} has no samples of points: a WebDataset of sweeps has files "
            "KEY.points.npy."
        )

    def sweeps_of(samples: list[tuple[float, Path, dict[str, tuple[int, int]]]]) -> SweepFiles:
        def read(number: int) -> Read:
            _, path, members = samples[number]
            arrays = {
                name.removesuffix(".npy"): read_npy(_slice(path, *span), name)
                for name, span in members.items()
                if name.endswith(".npy") and name != "boxes.npy"
            }
            pose = arrays.pop("pose", None)
            return arrays.pop("points"), arrays, pose

        times = np.array([time for time, _, _ in samples])
        return SweepFiles(len(samples), read, times)

    return {sensor: sweeps_of(samples) for sensor, samples in keys_of_sensor.items()}


def _samples(path: Path) -> dict[str, dict[str, tuple[int, int]]]:
    """Return the members of a tar file by sample, {key: {ending: (offset, bytes)}}."""
    input_size(path)
    samples: dict[str, dict[str, tuple[int, int]]] = {}
    with tarfile.open(path, "r:") as tar:
        for member in tar:
            folder, _, file = member.name.rpartition("/")
            key, _, ending = file.partition(".")
            samples.setdefault(f"{folder}/{key}", {})[ending] = (member.offset_data, member.size)
    return samples


def _slice(path: Path, offset: int, size: int) -> bytes:
    """Read some bytes of a file."""
    with path.open("rb") as file:
        file.seek(offset)
        return file.read(size)


def open_images(folder: Path) -> dict[str, SweepFiles]:
    """Open range images, {sensor: sweeps} of folders of .npz files; empty if there are none."""
    files_of_sensor = {
        inner.name: sorted(inner.glob("*.npz"), key=lambda file: natural(file.name))
        for inner in sorted(folder.iterdir())
        if inner.is_dir()
    }

    def sweeps_of(files: list[Path]) -> SweepFiles:
        def read(number: int) -> Read:
            with open_archive(files[number], partial(read_input, files[number])) as images:
                pose = images["pose"]
                points, columns = points_of_images(images)
            return points, columns, pose

        return SweepFiles(len(files), read)

    return {sensor: sweeps_of(files) for sensor, files in files_of_sensor.items() if files}


def _positions(columns: dict[str, AnyArray]) -> Floats:
    """Take columns x, y and z out, and return positions (n, 3); ValueError without these."""
    if missing := [axis for axis in "xyz" if axis not in columns]:
        raise ValueError(f"its points have no {', '.join(missing)}")
    return np.stack([np.asarray(columns.pop(axis), np.float64) for axis in "xyz"], axis=1)
