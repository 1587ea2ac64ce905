"""Trajectories from files: TUM, KITTI, and tables of named columns."""

from __future__ import annotations

import csv
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ..base.arrays import Floats
from ..base.errors import LidarpoolError
from ..base.input_files import read_input_text
from ..base.validation import checked
from ..base.vectors import determinant, matmul, turned
from .calibrations import said, text_of
from .trajectory import Beyond, Track, quaternions_of, rotations_of

TrajectoryFormat = Literal["tum", "kitti", "csv"]
Seconds = Annotated[float, Field(ge=-1e11, le=1e11)]
Duration = Annotated[float, Field(gt=0, le=1e9)]
_PLACE = ("x", "y", "z")
_TURNS = (("qx", "qy", "qz", "qw"), ("yaw_deg", "pitch_deg", "roll_deg"))
_MARKS = ",;\t"  # that separate the columns of a table
# Cameras look along z with y down; carriers look along x with z up.
_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@checked
def load_trajectory(
    path: str | Path,
    *,
    format: TrajectoryFormat | None = None,  # noqa: A002 - its name in scenarios
    times: str | Path | None = None,
    columns: Mapping[str, str] | None = None,
    camera_axes: bool | None = None,
    offset_s: Seconds = 0.0,
    smooth: bool = False,
    start_s: Seconds | None = None,
    duration_s: Duration | None = None,
    beyond: Beyond = "refuse",
) -> Track:
    """Read the trajectory of a carrier.

    Parameters
    ----------
    path
        TUM (rows of time, x, y, z, qx, qy, qz, qw), KITTI (rows of a 3 x 4 matrix), or a table
        with a header, separated by commas, semicolons or tabs: time_s or time_ns, x, y, z, and
        qx, qy, qz, qw, or any of yaw_deg, pitch_deg, roll_deg; without them the carrier faces its
        direction of travel.
    format
        "tum", "kitti" or "csv"; by default kitti with `times`, csv for a .csv, else tum.
    times
        For a KITTI file: the file with the seconds of its rows.
    columns
        For a table, {name as above: name in the file}, if they differ.
    camera_axes
        Whether to convert poses from camera axes (z ahead, y down) to a carrier's (x ahead,
        z up); by default for KITTI.
    offset_s
        Added to all times.
    smooth, start_s, duration_s, beyond
        As of `Track`.

    Raises
    ------
    LidarpoolError
        If it cannot be read, or is invalid; the message names the file.
    """
    path = Path(path)
    kind = format or ("kitti" if times else "csv" if path.suffix.lower() == ".csv" else "tum")
    try:
        text = text_of(path)
        if kind == "csv":
            seconds, places, turns = _table(text, dict(columns or {}))
        elif kind == "kitti":
            if times is None:
                raise ValueError("KITTI's poses have no times: give their file as times")
            seconds = _numbers(read_input_text(times), 1)[:, 0]
            rows = _numbers(text, 12).reshape(-1, 3, 4)
            if len(rows) != len(seconds):
                raise ValueError(f"it has {len(rows)} poses and {times} {len(seconds)} times")
            places, turns = rows[..., 3], quaternions_of(_rotations(rows[..., :3]))
        else:
            rows = _numbers(text, 8)
            seconds, places, turns = rows[:, 0], rows[:, 1:4], rows[:, 4:]
        track = Track(seconds + offset_s, places, turns, smooth, start_s, duration_s, beyond)
        if camera_axes or (camera_axes is None and kind == "kitti"):
            track = _from_camera(track)
        return track
    except (OSError, ValueError, LidarpoolError) as error:
        raise LidarpoolError(f"{path} is not a usable trajectory: {said(error)}") from error


def _numbers(text: str, columns: int | None = None, **options: Any) -> Floats:
    """Rows of numbers, by `np.loadtxt`; lines that begin with # are comments."""
    lines = [line for line in text.splitlines() if line.strip() and line.strip()[0] != "#"]
    if not lines:
        raise ValueError("it has no rows of numbers")
    rows = np.loadtxt(lines, ndmin=2, **options)
    if columns is not None and rows.shape[1:] != (columns,):
        raise ValueError(f"its rows have {rows.shape[1]} numbers, not {columns}")
    return rows


def _rotations(given: Floats) -> Floats:
    off = np.abs(matmul(given, given.transpose(0, 2, 1)) - np.eye(3)).max(axis=(1, 2))
    if not (off <= 2e-3).all() or (determinant(given) < 0).any():
        raise ValueError("it holds matrices that are no rotations")
    return given


def _table(text: str, names: dict[str, str]) -> tuple[Any, Any, Any]:
    """Seconds, positions and quaternions, or None, of a table with a header."""

    def needed(found: Container[str]) -> tuple[str, ...]:
        clock = "time_ns" if "time_ns" in found and "time_s" not in found else "time_s"
        return (clock, *_PLACE, *(_TURNS[0] if any(n in found for n in _TURNS[0]) else ()))

    known = ("time_s", "time_ns", *_PLACE, *_TURNS[0], *_TURNS[1])
    at = columns_of_table(text, names, known, needed)
    seconds = at["time_s"] if "time_s" in at else at["time_ns"] / 1e9
    places = np.stack([at[name] for name in _PLACE], axis=1)
    if _TURNS[0][0] in at:
        return seconds, places, np.stack([at[name] for name in _TURNS[0]], axis=1)
    if not any(name in at for name in _TURNS[1]):
        return seconds, places, None
    angles = [at.get(name, np.zeros(len(seconds))) for name in _TURNS[1]]
    return seconds, places, quaternions_of(rotations_of(np.stack(angles, axis=1)))


def columns_of_table(
    text: str,
    names: Mapping[str, str],
    known: Sequence[str],
    needed: Callable[[Container[str]], Sequence[str]],
) -> dict[str, Floats]:
    """Columns (k,) of a table with a header, by their names here; others are left out.

    Capital letters count only in `names`.

    Parameters
    ----------
    names
        {name here: name in the file}, where they differ.
    known
        All names here.
    needed
        Returns those that a table must have which has some columns.

    Raises
    ------
    ValueError
        If a column is missing, or a cell holds no finite number.
    """
    lines = text.splitlines()
    first, mark, head = head_of_table(lines)
    if unknown := [name for name in names if name not in known]:
        raise ValueError(f"columns names {unknown[0]!r}; possible names are {', '.join(known)}")
    small = [name.lower() for name in head]
    at = {}  # {name here: index}
    for name in known:
        if (there := names.get(name, name)) in head:
            at[name] = head.index(there)
        elif name not in names and name in small:
            at[name] = small.index(name)
    must = {**dict.fromkeys(needed(at)), **names}
    if missing := [names.get(name, name) for name in must if name not in at]:
        raise ValueError(f"it has no column {missing[0]!r}; it has {', '.join(head)}")
    used = list(at.values())  # others may hold text
    body = lines[first + 1 :]
    try:
        rows = _numbers("\n".join(body), delimiter=mark, quotechar='"', usecols=used)
        if not np.isfinite(rows).all():
            raise ValueError("it has a nan or inf")
    except ValueError as error:
        reader = csv.reader(body, delimiter=mark)
        for cells in reader:
            remark = not cells or cells[0].lstrip().startswith("#")
            for name, index in () if remark else at.items():
                cell = cells[index] if index < len(cells) else ""
                if not _is_finite(cell):
                    line = first + 1 + reader.line_num
                    more = "" if name in must else ", or leave the column out"
                    raise ValueError(
                        f"its column {head[index]!r} has {cell!r} in line {line}: give a number in "
                        f"every line{more}"
                    ) from error
        raise
    return dict(zip(at, rows.T, strict=True))


def head_of_table(lines: Sequence[str]) -> tuple[int, str, list[str]]:
    """Line of a table's header, what separates its columns, and their names."""
    # Remarks may come first, and some programs write # before the header as well.
    first = next((i for i, line in enumerate(lines) if any(m in line for m in _MARKS)), 0)
    mark = next((mark for mark in _MARKS if mark in lines[first]), ",")
    return first, mark, [name.strip().strip('"') for name in lines[first].split(mark)]


def _is_finite(cell: str) -> bool:
    try:
        return bool(np.isfinite(float(cell)))
    except ValueError:
        return False


def _from_camera(track: Track) -> Track:
    """Convert poses of a camera in camera axes to those of a carrier."""
    assert track.quaternions is not None  # of every track
    x, y, z, w = track.quaternions.T
    turns = np.stack([z, -x, -y, w], axis=1)  # the axis is rotated, the angle is the same
    places = turned(track.positions, _CAMERA)
    return replace(track, positions=places, quaternions=turns)
