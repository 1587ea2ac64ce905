"""Files whose names contain numbers, such as frame numbers or timestamps.

In a KITTI sequence, row k of a table such as `poses.txt` belongs to the file with number k, even if
other files have been deleted. Rows are therefore looked up by the number in the file name, not by
the position of the file.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from ..numerics.arrays import Ints
from ..words import plural

_NUMBER = re.compile(r"(\d+(?:\.\d+)?)")
_FRAME_DIGITS = 10  # number of digits in KITTI raw data; longer numbers are timestamps
_MAX_FRAME = 9_999_999  # larger numbers are times
_MAX_RUNS = 4  # maximum number of frame ranges in a message


def sort_by_number(files: Iterable[Path]) -> list[Path]:
    """Sort files by the numbers in their paths, so that 2.pcd precedes 10.pcd.

    Numbers may have decimals, so that 1000.05.pcd precedes 1000.1.pcd.
    """
    return sorted(files, key=lambda file: _order(file.as_posix()))


def _order(path: str) -> list[tuple[int, str]]:
    """Return a sort key that compares numbers by value, with any number of digits."""
    key = []
    for piece in _NUMBER.split(path):
        whole, _, decimals = piece.partition(".")
        is_number = whole.isdecimal()
        key.append((int(whole), decimals.rstrip("0")) if is_number else (-1, piece))
    return key


def rows_of_frames(files: Sequence[Path], row_count: int, table: str, kind: str) -> Ints:
    """Return the index of the table row that belongs to each file.

    Parameters
    ----------
    files
        Files in ascending order. If all names are frame numbers, row k belongs to the file with
        number k. Otherwise, the rows and files are in the same order.
    row_count
        Number of rows in the table.
    table, kind
        Name of the table and plural noun for the files, for error messages.

    Returns
    -------
    ndarray
        Row indices with shape (k,).

    Raises
    ------
    ValueError
        If a file has no row, or if a row has no file. Rows may lack files only if gaps in the file
        numbers show that these are row numbers.
    """
    count = len(files)
    if not all(file.stem.isdecimal() and len(file.stem) <= _FRAME_DIGITS for file in files):
        if row_count != count:
            raise ValueError(
                f"{table} has {plural(row_count, 'row')} for {count:,} {kind} whose names are not "
                "frame numbers. Write one row per file, or name the files 000000, 000001, …"
            )
        return np.arange(count)
    frames = np.array([int(file.stem) for file in files], np.int64)
    if missing := frames[frames >= row_count].tolist():
        raise ValueError(
            f"{table} has no row for {frames_in_words(missing)}. It has "
            f"{plural(row_count, 'row')}, and row k, counted from 0, belongs to file k. Add the "
            "missing rows, or rename the files."
        )
    surplus = frames_without_file(files, row_count)
    if surplus and frames[-1] == count - 1:
        raise ValueError(
            f"{table} has rows for {frames_in_words(surplus)}, but the {count:,} {kind} do not "
            "include these frames. If frames were skipped, delete these rows. If the files were "
            "renumbered, name each file after its row."
        )
    return frames


def frames_without_file(files: Sequence[Path], row_count: int) -> list[int]:
    """Return the numbers of the table rows that have no file."""
    frames = {int(file.stem) for file in files if file.stem.isdecimal()}
    return sorted({*range(row_count)} - frames) if frames else []


def skipped_frames(files: Sequence[Path]) -> list[int]:
    """Return the frame numbers that are missing between files in ascending order.

    The list is empty if not all names are frame numbers, or if the numbers are evenly spaced, for
    example if only every tenth frame was kept.
    """
    if not all(file.stem.isdecimal() for file in files):
        return []
    frames = np.array([int(file.stem) for file in files])
    steps = np.diff(frames)
    if not len(steps) or frames[-1] > _MAX_FRAME or (steps == steps[0]).all():
        return []
    return sorted({*range(int(frames[0]), int(frames[-1]))} - {*frames.tolist()})


def frames_in_words(frames: Sequence[int]) -> str:
    """Format ascending frame numbers as ranges, for example "frames 3, 5 to 9"."""
    numbers = np.asarray(frames)
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    words = [f"{run[0]}" if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs]
    more = ", …" if len(words) > _MAX_RUNS else ""
    return f"frame{'s' * (len(numbers) > 1)} {', '.join(words[:_MAX_RUNS])}{more}"
