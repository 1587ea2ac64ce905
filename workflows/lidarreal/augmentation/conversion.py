"""Write augmented sweeps in another format than that of their recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarfiles.clouds.posed_sweeps import PosedSweeps
from lidarfiles.clouds.recording import Recording
from lidarfiles.clouds.recording_ref import RecordingRef
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.parts.parts import StoredCloud, pack
from lidarsim.columns.column_names import COLORS, TIMES
from lidarsim.columns.part_columns import PartColumns
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import ALWAYS, AXES, TABLE, Column, columns_in_parts
from lidarsim.errors import LidarError
from lidarsim.io.storage import Storage
from lidarsim.motion.rotations import matrices, quaternions_of
from lidarsim.numerics.arrays import AnyArray, Bools, Floats
from lidarsim.numerics.even_samples import even_indices
from lidarsim.scene.transform import affine
from lidarsim.sweeps.lidar_traits import LidarTraits
from lidarsim.sweeps.sweeps import (
    AS_FIRED,
    COMPENSATED,
    UNKNOWN_MOTION,
    SweepPoses,
    Sweeps,
    actor_type,
)
from lidarsim.words import join_names

from .augmented_sweep import AugmentedSweep
from .rewriting.rewriter import EncodedSweeps, Rewriter, box_details, sweep_folder
from .rewriting.stored_records import convert_values

_PRECISION_M = 0.001  # of positions in world coordinates
_SENSOR_PRECISION_M = 0.0001  # of positions in the sensor frame, which formats store as float32
_BYTE_SCALE = 255.0  # full scale of most intensities
# Intensities with decimals that are lower are relative to a white surface.
_MAX_RELATIVE_INTENSITY = 16.0
_REFERENCE_SWEEPS = 5  # number of sweeps that determine the full scale
_PERIOD_NS = 1e8  # time between sweeps without timestamps
_MIN_EPOCH_NS = 1e17  # larger timestamps are times since 1970
# Values of required columns that the recording does not contain.
_NEUTRAL = {
    "channel": 0, "class": 0, "intensity": 0, "object": -1, "reflectivity": 0, "return_number": 0,
    "returns": 0, "signal": 0,
}  # fmt: skip
# Columns that are always written if the recording contains them, or if they can be derived.
_KEPT = ("time", "intensity", "reflectivity", "return_number", "returns", "class", "cause", *COLORS)
_STRENGTHS = ("intensity", "reflectivity", "signal")  # formats store one of them
_FRAMES = {True: COMPENSATED, False: AS_FIRED, None: UNKNOWN_MOTION}  # of the sensor
_DERIVED = ("range", "azimuth", "elevation")  # columns that follow from the positions


class FormatConverter(Rewriter):
    """Writer of an augmented recording in any export format.

    The sweeps are stored as parts in the work folder, from which the format is written. Intensities
    are divided by the full scale of the recording, so that they range from 0 to 1. Inserted objects
    become actors, whose boxes are written by formats with bounding boxes.

    Parameters
    ----------
    ref
        Reference to the recording, whose path is valid in this process.
    recording
        The recording, opened with `keep_noise=True`.
    spec
        Format to write.

    Raises
    ------
    LidarError
        If the format requires columns that recordings do not contain.
    """

    title = "Conversion"

    def __init__(self, ref: RecordingRef, recording: Recording, spec: ExportSpec) -> None:
        super().__init__(ref, recording)
        if spec.cloud_format.supports("compensated") and recording.info.compensated:
            spec = replace(spec, compensated=True)
        self.spec = spec
        known = {"scan", *_NEUTRAL, *_KEPT, *_DERIVED}
        if missing := [name for name in spec.needs if name not in known]:
            raise LidarError(
                f"The format {spec.format} requires the column {missing[0]}, which recordings do "
                "not contain. Choose another format with `--format`."
            )
        names = [name for name in dict.fromkeys((*_KEPT, *spec.added)) if name in known - {"scan"}]
        always = {column.name for column in ALWAYS}
        self._optional = tuple(TABLE[name] for name in names if name not in always)
        # Formats that store single sweeps receive the points in the sensor frame.
        self._in_sensor = spec.cloud_format.by_sweep
        self._precision_m = _SENSOR_PRECISION_M if self._in_sensor else _PRECISION_M

    @cached_property
    def _intensity_scale(self) -> _IntensityScale:
        numbers = even_indices(len(self.recording), _REFERENCE_SWEEPS).tolist()
        sweeps = [self.recording[number] for number in numbers]
        return _IntensityScale.from_sweeps(sweeps, energies=self.recording.info.energies)

    @cached_property
    def _poses(self) -> Floats | None:
        """Poses of all sweeps, or None if each sweep contains its pose."""
        if not self.recording.has_stored_poses:
            return None
        return self.recording.poses(range(len(self.recording)))

    @cached_property
    def _origin(self) -> Floats:
        """World coordinates to which the stored positions are relative, in whole meters."""
        if self._in_sensor or not len(self.recording):
            return np.zeros(3)
        pose = self._pose(0, self.recording[0])
        return np.zeros(3) if pose is None else np.rint(pose[:3, 3])

    def _pose(self, number: int, sweep: Sweep) -> Floats | None:
        return sweep.pose if self._poses is None else self._poses[number]

    @cached_property
    def _posed(self) -> PosedSweeps:
        return PosedSweeps(self.recording)

    def _positions(
        self, sweep: Sweep, points: Floats, pose: Floats | None, times_s: Floats | None
    ) -> Floats:
        """Transform the returns of a sweep to the coordinates that the format stores."""
        if pose is None or self._in_sensor:
            return points
        firing_poses = None
        if sweep.compensated is False:
            firing_poses = self._posed.firing_poses(sweep.number, pose, times_s)
        return Sweep(points, pose=pose, firing_poses=firing_poses).in_world()

    def encode(
        self, number: int, augmented: AugmentedSweep
    ) -> tuple[dict[str, bytes], dict[str, Any]]:
        """Return the part with the points of a sweep."""
        sweep = augmented.sweep.replace(number=number)
        augmented = replace(augmented, sweep=sweep)
        mask = sweep.has_return
        points = np.asarray(sweep.points, np.float64)[mask]
        pose = self._pose(number, sweep)
        all_times_s = self.recording.times_of(sweep)
        times_s = None if all_times_s is None else all_times_s[mask]
        positions = self._positions(sweep, points, pose, times_s)
        cells = np.rint((positions - self._origin) / self._precision_m)
        if np.abs(cells).max(initial=0) >= 1 << 31:
            raise LidarError(
                f"Sweep {number} contains points that are too far from the first sweep or from the "
                "sensor. Remove these points from the recording."
            )
        values = self._known_columns(augmented, mask, points, times_s)
        columns = {axis.name: cells[:, index].astype(axis.dtype) for index, axis in enumerate(AXES)}
        for column in columns_in_parts(self._optional)[len(AXES) :]:
            columns[column.name] = _converted(column, values.get(column.name), len(points))
        part = PartColumns(
            first=number,
            counts=np.array([len(points)], np.int64),
            columns=columns,
            triangles=np.zeros(0, np.int32),
            hits=np.zeros(0, np.int64),
            scan_hits=np.zeros(1, np.uint32),
            samples=np.zeros((1, 0, 3), np.float32),
        )
        box = part.cell_box
        details = {
            "kept": len(points),
            "known": sorted(values),
            "recorded": list(sweep.columns),
            "skipped": self._skipped(sweep),
            "cells": None if box is None else box.tolist(),
            "pose": None if pose is None else pose.tolist(),
            "span_s": [0.0, 0.0] if times_s is None else _span(times_s),
            "channels": int(columns["channel"].max(initial=0)) + 1,
            "objects": int(columns["object"].max(initial=-1)) + 1,
            "object_names": list(sweep.object_names),
            "boxes": box_details(augmented),
            "full_scale": self._intensity_scale.full_scale,
            "notes": self._posed.notes,
        }
        return {_part_file(number): b"".join(pack(part))}, details

    def _known_columns(
        self, augmented: AugmentedSweep, mask: Bools, points: Floats, times_s: Floats | None
    ) -> dict[str, AnyArray]:
        """Return the columns of the points with a return, as far as they are known."""
        columns = augmented.sweep.columns
        names = {"channel", "object", *(column.name for column in self._optional)}
        values = {name: np.asarray(columns[name])[mask] for name in names & columns.keys()}
        if "channel" not in values:
            rings = self.recording[augmented.sweep.number].rings
            if rings is not None:
                values["channel"] = np.maximum(rings[augmented.template][mask], 0)
        intensity = augmented.sweep.intensity
        full_scale = self._intensity_scale.full_scale
        for name in ("intensity", "signal", "time"):  # their scale and clock are unknown
            values.pop(name, None)
        if not self._intensity_scale.has_reflectivity:
            values.pop("reflectivity", None)
        if intensity is not None:
            energies = np.nan_to_num(np.asarray(intensity, np.float64)[mask]) / full_scale
            values["intensity"] = energies
            values.setdefault("reflectivity", 255 * energies)
            values["signal"] = 10_000 * energies
        if times_s is not None:
            stamp_ns = float(self._stamps_ns[augmented.sweep.number])
            values["time"] = stamp_ns + 1e9 * times_s
        x, y, z = points.T
        values["range"] = np.sqrt(x * x + y * y + z * z)
        values["azimuth"] = np.rad2deg(np.arctan2(y, x))
        values["elevation"] = np.rad2deg(np.arctan2(z, np.hypot(x, y)))
        return {name: values[name] for name in sorted(names & values.keys())}

    def _skipped(self, sweep: Sweep) -> list[str]:
        """Return the names of columns that are not converted."""
        known = {column.name for column in columns_in_parts(self._optional)}
        known |= {"scan", "distance", *_STRENGTHS, *_DERIVED}
        return [name for name in sweep.columns if name not in known and name not in TIMES]

    @property
    def ending(self) -> str:
        """End of the name of the file that is written, or an empty string for a folder."""
        return Path(self.spec.row.file).suffix

    def check_target(self, target: Path, *, overwrite: bool = False) -> None:
        """Raise LidarError unless the format can be written to a path."""
        self.spec.check_installed()
        super().check_target(target, overwrite=overwrite)

    def assemble(self, target: Path, encoded: EncodedSweeps, base: Path) -> list[str]:
        """Write the format from the parts of all sweeps.

        Raises LidarError if the sweeps of another sensor have already been written.
        """
        if base == target:
            raise LidarError(
                f"Only one sensor can be converted to {self.spec.title}. Choose it with `--topic`."
            )
        summary = _Summary.from_details(encoded)
        spec = self.spec
        has_times = "time" in summary.known
        if not has_times and spec.cloud_format.supports("compensated"):
            spec = replace(spec, compensated=True)
        sweeps = self._sweeps(encoded, summary)
        needed = {*spec.needs}
        optional = [
            column
            for column in self._optional
            if column.name in summary.known or column.name in needed
        ]
        cloud = StoredCloud(
            storage=Storage(str(encoded.folder)),
            names=[
                f"{sweep_folder(number)}/{_part_file(number)}" for number in range(encoded.count)
            ],
            firsts=[*range(encoded.count)],
            rows=summary.rows,
            columns=columns_in_parts(optional),
            cells=summary.cells,
            precision_m=self._precision_m,
            origin=self._origin,
            sweeps=lambda: sweeps,
        )
        spec.write(target, cloud, sweeps)
        unsupported = [
            name
            for name in spec.unsupported_columns(cloud, sweeps)
            if name in summary.recorded and name not in _STRENGTHS
        ]
        notes = self._notes(summary, needed)
        placed = (note for details in encoded.details() for note in details["notes"])
        notes += [f"{note}." for note in dict.fromkeys(placed)]
        empty = spec.describe_empty_fields(cloud, sweeps, source=self.ref.name)
        notes += [f"{spec.title} {text}." for text in empty]
        if unsupported:
            notes.append(f"{spec.title} cannot store {join_names(unsupported)}.")
        return notes

    @cached_property
    def _stamps_ns(self) -> Floats:
        """Timestamps of the sweeps in nanoseconds since the first timestamp."""
        stamps_ns = self.recording.stamps_ns
        if stamps_ns is None or not len(stamps_ns):
            return np.arange(0, _PERIOD_NS * len(self.recording), _PERIOD_NS)
        return np.asarray(stamps_ns - stamps_ns[0], np.float64)

    def _sweeps(self, encoded: EncodedSweeps, summary: _Summary) -> Sweeps:
        """Return the times and poses of the sweeps, and the boxes of inserted objects."""
        count = encoded.count
        poses = np.tile(np.eye(4), (count, 1, 1))
        for number, details in enumerate(encoded.details()):
            if details["pose"] is not None:
                poses[number] = details["pose"]
        first_s, last_s = summary.spans_s.T
        stamps_ns = self._stamps_ns
        stated_ns = self.recording.stamps_ns
        epoch_ns = None if stated_ns is None or not len(stated_ns) else int(stated_ns[0])
        actors = _InsertedActors(encoded, poses)
        objects = [
            summary.object_names[number]
            if number < len(summary.object_names)
            else f"Object {number}"
            for number in range(actors.first if actors.names else summary.objects)
        ]
        return Sweeps(
            scans=np.arange(count + 1),
            begins_ns=stamps_ns + 1e9 * np.minimum(first_s, 0),
            ends_ns=stamps_ns + 1e9 * np.maximum(last_s, 0),
            sensor=np.zeros(count, np.uint8),
            pose=_sweep_poses(poses),
            mounts=_sweep_poses(np.eye(4)[None]),
            sensors=("",),
            objects=tuple(objects),
            actors=tuple(actors.names),
            actor_poses=actors.poses(),
            actor_velocities=actors.velocities(stamps_ns),
            actor_bounds=actors.bounds,
            actor_there=actors.present,
            actor_comes=np.zeros_like(actors.present),
            actor_leaves=np.zeros_like(actors.present),
            coordinates="sensor" if self._in_sensor else "world",
            precision_m=self._precision_m,
            epsg=None if self._in_sensor else self.recording.info.epsg,
            start_ns=epoch_ns if epoch_ns is not None and epoch_ns > _MIN_EPOCH_NS else None,
            lidars=(LidarTraits(summary.channels, mode=""),),
            stated_frame=_FRAMES[self.recording.info.compensated],
        )

    def _notes(self, summary: _Summary, needed: set[str]) -> list[str]:
        name = self.ref.name
        notes = []
        if summary.without_pose:
            which = "" if summary.without_pose == len(summary.rows) else " of some sweeps"
            notes.append(f"{name} has no poses{which}, so these sweeps are at the origin.")
        if self.recording.stamps_ns is None:
            notes.append(
                f"{name} has no timestamps, so its sweeps are assumed to be "
                f"{1e-9 * _PERIOD_NS:g} s apart."
            )
        if summary.full_scale != 1:
            notes.append(
                f"Intensities from 0 to {summary.full_scale:g} in {name} are written as 0 to 1, on "
                "the intensity scale of lidarpool."
            )
        missing = sorted(needed - summary.known - {"scan", "time"})
        notes += [
            f"{name} has no column {column}, which {self.spec.title} requires. It is "
            f"{_NEUTRAL[column]} for all points."
            for column in missing
        ]
        if summary.skipped:
            skipped = join_names(summary.skipped)
            noun = "column" if len(summary.skipped) == 1 else "columns"
            notes.append(f"The {noun} {skipped} of {name} cannot be converted.")
        return notes


class _IntensityScale(NamedTuple):
    """Scale of the intensities of a recording."""

    full_scale: float  # intensity that becomes 1
    has_reflectivity: bool  # whether there are intensities and also reflectivities from 0 to 255

    @classmethod
    def from_sweeps(cls, sweeps: Sequence[Sweep], *, energies: bool) -> _IntensityScale:
        """Determine the scale from several sweeps.

        The full scale is 1, 255 or a power of two. `energies` states whether the intensities
        already are energies.
        """
        parts = [s.intensity for s in sweeps if s.intensity is not None and len(s)]
        values = np.nan_to_num(np.concatenate(parts)) if parts else np.zeros(1)
        highest = float(values.max())
        has_decimals = bool((values % 1 != 0).any())
        if energies or highest <= 1 or (has_decimals and highest <= _MAX_RELATIVE_INTENSITY):
            full_scale = 1.0
        elif highest <= _BYTE_SCALE:
            full_scale = _BYTE_SCALE
        else:
            full_scale = 2.0 ** np.ceil(np.log2(highest))
        columns = [sweep.columns for sweep in sweeps]
        bytes_of_sweeps = [
            np.asarray(values["reflectivity"]).max(initial=0) <= _BYTE_SCALE
            and np.asarray(values["reflectivity"]).dtype.kind in "iu"
            for values in columns
            if values.keys() >= {"intensity", "reflectivity"}
        ]
        return cls(full_scale, bool(bytes_of_sweeps) and all(bytes_of_sweeps))


def _part_file(number: int) -> str:
    return f"parts/{number:08}.npz"


def _span(times_s: Floats) -> list[float]:
    return [float(times_s.min()), float(times_s.max())] if len(times_s) else [0.0, 0.0]


def _sweep_poses(poses: Floats) -> SweepPoses:
    quaternions = quaternions_of(poses[:, :3, :3])
    quaternions[quaternions[:, 3] < 0] *= -1
    return SweepPoses(poses[:, :3, 3].copy(), quaternions)


def _converted(column: Column, values: AnyArray | None, count: int) -> AnyArray:
    """Return the values of a column with its dtype, or neutral values if they are unknown."""
    dtype = np.dtype(column.dtype)
    if values is None:
        return np.full(count, _NEUTRAL.get(column.name, 0), dtype)
    return convert_values(values, dtype)


class _InsertedActors:
    """Inserted objects of all sweeps as actors, whose numbers follow those of the other objects.

    Attributes
    ----------
    first
        Number of the first actor in the column `object`.
    names
        Names of the a actors.
    positions, rotations
        (a, n, 3) and (a, n, 3, 3): poses in world coordinates, in meters.
    bounds
        (a, 2, 3): corners of the boxes in the frame of the actor, in meters.
    present
        (a, n): whether an actor is present in a sweep.
    """

    def __init__(self, encoded: EncodedSweeps, poses: Floats) -> None:
        boxes = [
            (sweep, box)
            for sweep, details in enumerate(encoded.details())
            for box in details["boxes"]
        ]
        numbers = [box["object"] for _, box in boxes]
        self.first = min(numbers, default=0)
        count = max(numbers, default=self.first - 1) + 1 - self.first
        shape = count, encoded.count
        self.names = [f"Object {self.first + actor}" for actor in range(count)]
        self.positions = np.zeros((*shape, 3))
        self.rotations = np.broadcast_to(np.eye(3), (*shape, 3, 3)).copy()
        self.bounds = np.zeros((count, 2, 3))
        self.present = np.zeros(shape, bool)
        for sweep, box in boxes:
            actor = box["object"] - self.first
            pose = poses[sweep]
            (rotation,) = matrices(np.array([box["quaternion"]]))
            self.positions[actor, sweep] = pose[:3, :3] @ np.array(box["center"]) + pose[:3, 3]
            self.rotations[actor, sweep] = pose[:3, :3] @ rotation
            self.bounds[actor] = np.array([[-0.5], [0.5]]) * box["size"]
            self.present[actor, sweep] = True
            kind = "_".join(box["type"].split())
            name = box["name"]
            self.names[actor] = name if actor_type(name) == kind else f"{kind} {actor + 1}"

    def poses(self) -> SweepPoses:
        """Return the poses of the actors at the start of each sweep."""
        flat = _sweep_poses(affine(self.rotations, self.positions).reshape(-1, 4, 4))
        shape = self.present.shape
        return SweepPoses(flat.positions.reshape(*shape, 3), flat.quaternions.reshape(*shape, 4))

    def velocities(self, stamps_ns: Floats) -> Floats:
        """Return the velocities from the sweep before to the next sweep with the actor, in m/s.

        The shape is (a, n, 3). The velocity is zero if the actor is present in a single sweep.
        """
        velocities = np.zeros(self.positions.shape)
        for actor, present in enumerate(self.present):
            sweeps = np.flatnonzero(present)
            seconds = 1e-9 * stamps_ns[sweeps]
            if len(sweeps) > 1 and (np.diff(seconds) > 0).all():
                positions = self.positions[actor, sweeps]
                velocities[actor, sweeps] = np.gradient(positions, seconds, axis=0)
        return velocities


class _Summary(NamedTuple):
    """Details of all sweeps."""

    rows: list[int]
    known: set[str]  # columns with known values
    recorded: set[str]  # columns of the recording
    skipped: list[str]  # columns that are not converted
    cells: AnyArray | None
    spans_s: Floats  # (n, 2), times of the first and last point since the timestamp
    channels: int
    objects: int
    object_names: list[str]
    without_pose: int
    full_scale: float

    @classmethod
    def from_details(cls, encoded: EncodedSweeps) -> _Summary:
        all_details = [*encoded.details()]
        boxes = [details["cells"] for details in all_details if details["cells"] is not None]
        cells = None
        if boxes:
            lowest = np.min([box[0] for box in boxes], axis=0)
            cells = np.stack([lowest, np.max([box[1] for box in boxes], axis=0)])
        return cls(
            [details["kept"] for details in all_details],
            {name for details in all_details for name in details["known"]},
            {name for details in all_details for name in details["recorded"]} - {"cause"},
            [*dict.fromkeys(name for details in all_details for name in details["skipped"])],
            cells,
            np.reshape([details["span_s"] for details in all_details], (-1, 2)),
            max((details["channels"] for details in all_details), default=1),
            max((details["objects"] for details in all_details), default=0),
            max((details["object_names"] for details in all_details), key=len, default=[]),
            sum(details["pose"] is None for details in all_details),
            all_details[0]["full_scale"] if all_details else 1.0,
        )
