"""Reader for trajectory files: TUM, KITTI, tables, oxts folders and ROS 2 bags."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from ..columns.bags import is_bag
from ..errors import LidarError, message_of
from ..io.tables import column_name, find_header, read_table
from ..io.textfile import read_text
from ..io.time_units import TimeUnit, seconds_of
from ..numerics.arrays import Floats
from ..numerics.vectors import rotate
from ..schema.checks import check_fits, check_list
from .bag_trajectories import read_bag
from .oxts import OXTS_TIMES, WIDTH, find_oxts, oxts_files, oxts_poses, parse_dates, read_oxts
from .pose_columns import (
    ANGLES,
    POSE_TABLES,
    POSITION,
    QUATERNION,
    REFUSED_COLUMNS,
    TIME,
    convert_heading,
    stack_angles,
)
from .rotations import check_rotations, quaternions_of, rotations_of
from .trajectory import QUATERNION_SLACK, Beyond, Track

TrajectoryFormat = Literal["tum", "kitti", "csv", "oxts", "bag"]
Seconds = Annotated[float, Field(ge=-1e11, le=1e11)]
Duration = Annotated[float, Field(gt=0, le=1e9)]
Latitude = Annotated[float, Field(gt=-90, lt=90)]
Longitude = Annotated[float, Field(ge=-360, le=360)]
Height = Annotated[float, Field(ge=-1e5, le=1e6)]
Origin = tuple[Latitude, Longitude, Height]
_KITTI_WIDTH = 12  # number of values in a row
# Rotation from a camera frame (z forward, y down) to a platform frame (x forward, z up).
_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
# The units and the order of rotations in a HELIOS++ .trj file are only defined by its survey.
_HELIOS = " To read a HELIOS++ .trj with its survey, run `lidarpool import`."


class PoseTable(NamedTuple):
    """Poses read from a file."""

    seconds: Floats  # (k,)
    positions: Floats  # (k, 3), meters
    quaternions: Floats | None  # (k, 4), (x, y, z, w), or None if the file has no orientations


class TimeOptions(NamedTuple):
    """Options that define the times of a pose file."""

    file: str | Path | None  # file that contains the times of KITTI poses
    unit: TimeUnit | None


def load_trajectory(
    path: str | Path,
    *,
    format: TrajectoryFormat | None = None,  # noqa: A002 - its name in scenarios
    times: str | Path | None = None,
    time_unit: TimeUnit | None = None,
    columns: Mapping[str, str] | None = None,
    ignore: Sequence[str] = (),
    topic: str | None = None,
    origin: tuple[float, float, float] | None = None,
    camera_axes: bool | None = None,
    offset_s: float = 0.0,
    smooth: bool = False,
    start_s: float | None = None,
    duration_s: float | None = None,
    beyond: Beyond = "refuse",
) -> Track:
    """Read the trajectory of a platform from a file.

    Parameters
    ----------
    path
        Path of the file or folder. The supported formats are TUM (rows of time, x, y, z, qx, qy,
        qz, qw), KITTI poses (rows of a 3 x 4 matrix), tables with a header (separated by commas,
        semicolons, tabs or spaces, such as EuRoC's data.csv), KITTI oxts folders, and ROS 2 bags
        (.mcap, .db3 or the bag folder), which require the ``ros`` extra. A table must contain
        time_s (or time_ns), x, y and z. Rotations are optional: either qx, qy, qz and qw, or
        yaw_deg (or heading_deg, clockwise from y) with pitch_deg and roll_deg. Without rotations,
        the platform faces its direction of travel.
    format
        "tum", "kitti", "csv", "oxts" or "bag". By default, the format is determined from the
        content.
    times
        For KITTI poses or a file with oxts rows, the file that contains the times of the rows, in
        seconds or as dates, such as KITTI's timestamps.txt.
    time_unit
        Unit of the times in the file ("s", "ms", "us" or "ns"), if it differs from the unit in the
        header or the default unit of the format. Without `time_unit`, times of 1e11 s or more, and
        times that span more than a year, raise an error.
    columns
        For a table with other column names, a mapping from the names listed above to the names in
        the file.
    ignore
        For a table, names of columns to skip; * and ? are wildcards. Any other unused column raises
        an error.
    topic
        For a bag with several topics, the topic to read. It can be a topic with Odometry,
        PoseStamped, PoseWithCovarianceStamped, TransformStamped or NavSatFix messages, or
        "/tf:FRAME" for a frame. To combine positions with orientations, pass a NavSatFix topic and
        an Imu topic, separated by a space.
    origin
        For geographic coordinates, the world origin as latitude and longitude in degrees, and
        height in meters. The default is the first position.
    camera_axes
        Whether to convert poses from a camera frame (z forward, y down) to a platform frame (x
        forward, z up). By default, only KITTI poses are converted.
    offset_s
        Offset in seconds that is added to all times.
    smooth
        Whether the platform follows smooth curves, as in `Track`.
    start_s, duration_s
        Start and duration of the survey in seconds, within the times in the file. By default, the
        entire trajectory is used.
    beyond
        Behavior before the first and after the last time, as in `Track`.

    Raises
    ------
    LidarError
        If the file cannot be read, is invalid, or contains unsupported data. The message contains
        the name of the file.
    """
    path = Path(path)
    check_fits("format", format, TrajectoryFormat | None)
    check_fits("time_unit", time_unit, TimeUnit | None)
    check_fits("origin", origin, Origin | None)
    check_list("ignore", ignore)
    timing = TimeOptions(times, time_unit)
    try:
        if path.is_dir() or is_bag(path) or format in ("oxts", "bag"):
            kind, poses = _read_container(path, format, timing, topic, origin)
        else:
            _refuse_topic(topic)
            text = read_text(path)
            kind, poses = _parse_text(text, format, timing, columns or {}, ignore, origin)
        if (columns or ignore) and kind != "csv":
            raise ValueError(
                f"columns and ignore require a table with a header, but the format is {kind}"
            )
        if origin is not None and kind not in ("oxts", "bag"):
            raise ValueError(f"origin requires latitudes and longitudes, but the format is {kind}")
        seconds, positions, quaternions = poses
        seconds = seconds + offset_s
        track = Track(
            times_s=seconds,
            positions=positions,
            quaternions=quaternions,
            smooth=smooth,
            start_s=start_s,
            duration_s=duration_s,
            beyond=beyond,
        )
        if camera_axes or (camera_axes is None and kind == "kitti"):
            track = _convert_from_camera(track)
        return track
    except (OSError, ValueError, LidarError) as error:
        note = _HELIOS if path.suffix.lower() == ".trj" else ""
        raise LidarError(f"{path} is not a valid trajectory: {message_of(error)}{note}") from error


def read_kitti_poses(path: Path) -> Floats | None:
    """Read the matrices in a file of KITTI poses, which contains no times.

    Returns
    -------
    array or None
        Matrices of shape (k, 3, 4), or None if the file has another format or cannot be read.

    Raises
    ------
    LidarError
        If a matrix does not contain a rotation.
    """
    if path.is_dir() or is_bag(path):
        return None
    try:
        text = read_text(path)
        has_header = find_header(text.splitlines(), _is_pose_column) is not None
        rows = np.empty((0, 0)) if has_header else _parse_numbers(text)
    except (OSError, ValueError, LidarError):  # `load_trajectory` reports the error
        return None
    if rows.shape[1] != _KITTI_WIDTH:
        return None
    matrices = rows.reshape(-1, 3, 4)
    try:
        check_rotations(matrices[..., :3], slack=2 * QUATERNION_SLACK)
    except (ValueError, LidarError) as error:
        raise LidarError(f"{path} is not a valid trajectory: {message_of(error)}") from error
    return matrices


def list_trajectory_files(path: Path) -> list[Path]:
    """Return the files of a trajectory: the path itself, or the files in its folder."""
    if not path.is_dir():
        return [path]
    if is_bag(path):
        return sorted(file for file in path.iterdir() if file.is_file())
    folder = find_oxts(path)
    return [path] if folder is None else [*oxts_files(folder), folder / OXTS_TIMES]


def _refuse_topic(topic: str | None) -> None:
    """Raise ValueError if a topic is set for a file that is not a bag."""
    if topic is not None:
        raise ValueError("topic requires a bag, but this file is not a bag")


def _read_container(
    path: Path,
    kind: TrajectoryFormat | None,
    timing: TimeOptions,
    topic: str | None,
    origin: Sequence[float] | None,
) -> tuple[str, PoseTable]:
    """Read a folder or a bag. Return its format and its poses."""
    if not path.exists():
        raise FileNotFoundError(2, "No such file or directory")
    if is_bag(path) and kind in (None, "bag"):
        if timing.file is not None:
            raise ValueError("a bag contains its own times. Remove `times`")
        found = read_bag(path, topic, origin)
        if found.skipped:
            raise ValueError(f"the bag {found.skipped}. Remove them from the bag")
        seconds = seconds_of(found.seconds, timing.unit)
        return "bag", PoseTable(seconds, found.positions, found.quaternions)
    _refuse_topic(topic)
    folder = find_oxts(path)
    if folder is not None and kind in (None, "oxts"):
        if timing.file is not None:
            raise ValueError("an oxts folder contains its own times. Remove `times`")
        poses = PoseTable(*read_oxts(folder, origin))
        return "oxts", poses._replace(seconds=_seconds_of_dates(poses.seconds, timing.unit))
    if path.is_file() and kind == "oxts":
        return _parse_text(read_text(path), kind, timing, {}, (), origin)
    raise ValueError(
        "a folder must be a KITTI folder with timestamps.txt and data, or a ROS 2 bag with "
        f"metadata.yaml{'' if kind is None else f', but format is {kind}'}"
    )


def _parse_text(
    text: str,
    kind: TrajectoryFormat | None,
    timing: TimeOptions,
    columns: Mapping[str, str],
    ignore: Sequence[str],
    origin: Sequence[float] | None,
) -> tuple[str, PoseTable]:
    """Parse the content of a text file. Return its format and its poses."""
    lines = text.splitlines()
    if timing.file is not None and kind not in (None, "kitti", "oxts"):
        raise ValueError(f"times can only be combined with KITTI poses, but format is {kind}")
    header = find_header(lines, _is_pose_column) if timing.file is None else None
    if kind == "csv" or (kind in (None, "tum") and header is not None):
        # The values in TUM rows are separated by spaces, and the header may be in a comment.
        in_remark = header is not None and header.comment and header.separator is None
        bare = {"time_s": "s"} if in_remark or kind == "tum" else {}
        return "csv", _parse_table(text, columns, ignore, bare, timing.unit)
    return _parse_rows(_parse_numbers(text), kind, timing, origin)


def _parse_rows(
    rows: Floats,
    kind: TrajectoryFormat | None,
    timing: TimeOptions,
    origin: Sequence[float] | None,
) -> tuple[str, PoseTable]:
    """Parse rows of numbers without a header. Return their format and poses."""
    width = rows.shape[1]
    if kind is None:
        kind = (
            "oxts" if width == WIDTH else "kitti" if timing.file or width == _KITTI_WIDTH else "tum"
        )
    if kind == "tum":
        if width != 8:
            raise ValueError(
                f"its rows have {width} numbers and no header. TUM rows have 8 numbers and KITTI "
                "rows have 12. Any other table requires a header, such as time_s,x,y,z,yaw_deg"
            )
        return kind, PoseTable(seconds_of(rows[:, 0], timing.unit), rows[:, 1:4], rows[:, 4:])
    if timing.file is None:
        raise ValueError("KITTI poses have no times. Set `times` to the file that contains them")
    seconds = _seconds_in_file(Path(timing.file), timing.unit)
    expected = WIDTH if kind == "oxts" else _KITTI_WIDTH
    if width != expected:
        raise ValueError(f"its rows have {width} numbers instead of {expected}")
    if len(rows) != len(seconds):
        raise ValueError(f"it has {len(rows)} poses, but {timing.file} has {len(seconds)} times")
    if kind == "oxts":
        return kind, PoseTable(seconds, *oxts_poses(rows, origin))
    poses = rows.reshape(-1, 3, 4)
    check_rotations(poses[..., :3], slack=2 * QUATERNION_SLACK)
    return kind, PoseTable(seconds, poses[..., 3], quaternions_of(poses[..., :3]))


def _seconds_in_file(path: Path, unit: TimeUnit | None) -> Floats:
    """Read times in seconds from a file with a number or a date in each row."""
    try:
        text = read_text(path)
        dates = parse_dates(text)
        has_dates = dates is not None and len(dates) > 0
        times = dates if has_dates else _parse_numbers(text, 1)[:, 0]
    except ValueError as error:
        raise ValueError(f"{path} has no times: {message_of(error)}") from error
    assert times is not None  # set from either dates or numbers
    try:
        return _seconds_of_dates(times, unit) if has_dates else seconds_of(times, unit)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _seconds_of_dates(seconds: Floats, unit: TimeUnit | None) -> Floats:
    """Validate times that were parsed from dates. Raises ValueError if a time unit is set."""
    if unit is not None:
        raise ValueError("its times are dates, so time_unit cannot be set")
    return seconds_of(seconds, None, advice="Correct them")


def _is_pose_column(cell: str) -> bool:
    """Return whether a header cell names a component of a pose."""
    words = column_name(cell).words
    return any(
        words in {column_name(name).words for name in quantity.spellings}
        for quantity in (TIME, *POSITION, *QUATERNION, *ANGLES)
    )


def _parse_numbers(text: str, columns: int | None = None) -> Floats:
    """Parse the rows of numbers in a text, skipping comments that start with #.

    The rows must have `columns` numbers, if it is set.
    """
    lines = [line for line in text.splitlines() if line.strip() and line.strip()[0] != "#"]
    if not lines:
        raise ValueError("it has no rows of numbers")
    try:
        rows = np.loadtxt(lines, ndmin=2)
    except ValueError as error:
        if "," in lines[0] or ";" in lines[0]:
            raise ValueError(
                "it has no header. Name its columns in the first line, for example "
                "time_s,x,y,z,qx,qy,qz,qw"
            ) from error
        raise
    if columns is not None and rows.shape[1:] != (columns,):
        raise ValueError(f"its rows have {rows.shape[1]} numbers instead of {columns}")
    return rows


def _parse_table(
    text: str,
    names: Mapping[str, str],
    ignore: Sequence[str],
    bare: Mapping[str, str],
    time_unit: TimeUnit | None,
) -> PoseTable:
    """Parse the poses in a table with a header.

    Columns whose header has no unit have the unit in `bare`.
    """
    quaternion = [quantity.name for quantity in QUATERNION]

    def required_columns(columns: Mapping[str, Floats]) -> tuple[str, ...]:
        rotation_columns = quaternion if any(name in columns for name in quaternion) else ()
        return ("time_s", "x", "y", "z", *rotation_columns)

    columns = convert_heading(
        read_table(
            text,
            (TIME, *POSITION, *QUATERNION, *ANGLES),
            required=required_columns,
            columns=names,
            ignore=ignore,
            formats=POSE_TABLES,
            refused=REFUSED_COLUMNS,
            bare=bare,
            time_unit=time_unit,
        )
    )
    seconds = columns["time_s"]
    positions = np.stack([columns[name] for name in "xyz"], axis=1)
    angles = [name for name in ("yaw_deg", "pitch_deg", "roll_deg") if name in columns]
    if "qx" in columns:
        if angles:
            raise ValueError(f"it has both a quaternion and {angles[0]}. Ignore one of them")
        quaternions = np.stack([columns[name] for name in quaternion], axis=1)
        return PoseTable(seconds, positions, quaternions)
    if not angles:
        return PoseTable(seconds, positions, None)
    if "yaw_deg" not in angles:
        raise ValueError(
            f"it has {angles[0]} but neither yaw_deg nor heading_deg. Add one of them, or ignore "
            f"{angles[0]} to face the direction of travel"
        )
    return PoseTable(
        seconds, positions, quaternions_of(rotations_of(stack_angles(columns, len(seconds))))
    )


def _convert_from_camera(track: Track) -> Track:
    """Convert poses of a camera frame to poses of the platform frame."""
    positions = rotate(track.positions, _CAMERA)
    if track.quaternions is None:
        return replace(track, positions=positions)
    x, y, z, w = track.quaternions.T
    quaternions = np.stack([z, -x, -y, w], axis=1)  # rotates the axis and keeps the angle
    return replace(track, positions=positions, quaternions=quaternions)
