"""Read and write PCD files, with one file per sweep."""

from __future__ import annotations

from contextlib import nullcontext
from functools import cached_property
from pathlib import Path

import numpy as np

from lidarsim.columns.cloud import Cloud
from lidarsim.columns.column_names import STRENGTHS, with_standard_names
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import COLORS, NORMAL
from lidarsim.environment.extras import reading
from lidarsim.io.input_files import open_input
from lidarsim.io.numbered_files import frames_in_words, skipped_frames, sort_by_number
from lidarsim.numerics.arrays import AnyArray
from lidarsim.scene.colors import pack_as_float
from lidarsim.scene.files.pcd import pcd_bytes, read_pcd
from lidarsim.sweeps.sweeps import states_compensation

from .format_options import FormatOptions
from .multi_file_format import MultiFileFormat
from .point_field import OMITTED, PointField
from .recording import FileRecording, Recording
from .recording_ref import RecordingRef

_COMMENT_BYTES = 1000  # maximum number of bytes that are read from the first line


class PCD(MultiFileFormat):
    """A folder with one PCD file per sweep, which contains all columns.

    By default, each point is in the sensor frame at the time of its firing, and the field of times
    contains seconds since the start of the sweep as float32. If points are motion-compensated, or
    if the cloud has no times, all points are in the sensor frame at the start of the sweep and have
    no times. A comment in the file states which of these applies.

    Red, green and blue are combined in the field `rgb`. VIEWPOINT is the pose of the sensor in the
    world frame at the start of the sweep. Normals and ray origins are in the frame of the points.
    Normals have the field names that PCL uses.
    """

    title = "PCD"
    by_sweep = True
    frame = "firing"
    fields = (
        PointField("intensity", ("intensity",), OMITTED),
        PointField("time", ("time",), OMITTED),
        PointField("rgb", COLORS, OMITTED, on_request=True),
        PointField("normal_x, normal_y, normal_z", NORMAL, OMITTED, on_request=True),
    )
    options = ("compensated",)
    file_pattern = r"\d+\.pcd"
    for_scenes = True

    @classmethod
    def fields_for(cls, spec: FormatOptions) -> tuple[PointField, ...]:
        """Return the fields of a point, which has no time if it is motion-compensated."""
        return tuple(f for f in cls.fields if f.name != "time" or not spec.compensated)

    def files(self, number: int, points: Cloud) -> tuple[dict[str, bytes], None]:
        """Return the file of a sweep."""
        as_fired = "time" in points.columns and not self.compensated
        fields = self._fields(number, points, as_fired=as_fired)
        x, y, z, w = self.sweeps.pose.quaternions[number].tolist()
        position = self.sweeps.pose.positions[number].tolist()
        comment = self.sweeps.frame_text(compensated=not as_fired)
        return {f"{number:06}.pcd": pcd_bytes(fields, position, (w, x, y, z), comment)}, None

    def _fields(self, number: int, points: Cloud, *, as_fired: bool) -> list[tuple[str, AnyArray]]:
        """Return the fields of a sweep's PCD file as pairs of a name and an array.

        If `as_fired` is True, each point is in the sensor frame at the time of its firing.
        Otherwise, the points are motion-compensated.
        """
        sweeps = self.sweeps
        positions_of = sweeps.as_fired if as_fired else sweeps.compensate_motion
        columns_of = sweeps.columns_as_fired if as_fired else sweeps.columns_compensated
        positions = positions_of(number, points).T.astype(np.float32)
        fields: list[tuple[str, AnyArray]] = [*zip("xyz", positions, strict=True)]
        columns = columns_of(number, points)
        colored = {*COLORS} <= {*columns}
        if colored:
            fields.append(("rgb", pack_as_float(*(points[name] for name in COLORS))))
        for column in self.cloud.table:
            if (colored and column.name in COLORS) or (column.name == "time" and not as_fired):
                continue
            values = columns[column.name]
            if column.name == "time":
                values = ((values - sweeps.begins_ns[number]) / 1e9).astype(np.float32)
            elif values.dtype.kind in "iu" and values.dtype.itemsize == 8:
                values = values.astype(np.float64)
            name = column.name if column.name in NORMAL else column.in_files
            fields.append((name, values))
        return fields

    @classmethod
    def open(cls, ref: RecordingRef) -> Recording:
        """Open a PCD file, or a folder with one file per sweep.

        The pose of each sweep is the VIEWPOINT in its file.
        """
        return _PCDRecording(ref, point_files(ref.path))


def point_files(path: Path) -> list[Path]:
    """Return the files of a recording in the order of its sweeps."""
    if not path.is_dir():
        return [path]
    return sort_by_number(file for file in path.iterdir() if file.suffix.lower() == ".pcd")


class _PCDRecording(FileRecording):
    """PCD files, each with the points of a sweep."""

    def __init__(self, ref: RecordingRef, files: list[Path]) -> None:
        notes = []
        if skipped := skipped_frames(files):
            notes.append(
                f"has no file for {frames_in_words(skipped)} and no times, so its sweeps are "
                "treated as evenly spaced"
            )
        super().__init__(
            ref.info(
                meters=ref.chosen_meters(),
                compensated=_stated_compensation(files[0]),
                files=tuple(path.name for path in files),
                notes=ref.prefix_notes(notes),
            ),
            files,
        )

    def load(self, number: int) -> Sweep:
        path = self.paths[number]
        with reading(path.name) if len(self) > 1 else nullcontext():
            (sweep,) = read_pcd(path)
            first = self._first_intensity if number else None
            if number and (name := _intensity_name(sweep)) != first:
                raise ValueError(
                    f"its intensities are in {name or 'no column'}, but those of "
                    f"{self.paths[0].name} are in {first or 'no column'}. Use files with the same "
                    "columns"
                )
        return sweep

    @cached_property
    def _first_intensity(self) -> str | None:
        return _intensity_name(read_pcd(self.paths[0])[0])


def _intensity_name(sweep: Sweep) -> str | None:
    """Return the name of the column from which the intensities of a sweep are read, or None."""
    names = with_standard_names(sweep.columns)
    return next((name for name in STRENGTHS if name in names), None)


def _stated_compensation(path: Path) -> bool | None:
    """Return whether a file is motion-compensated, or None if it does not state this."""
    try:
        with open_input(path) as file:
            comment = file.readline(_COMMENT_BYTES).decode(errors="replace")
    except OSError:  # reading the points raises the error again, with the name of the file
        return None
    return states_compensation(comment)
