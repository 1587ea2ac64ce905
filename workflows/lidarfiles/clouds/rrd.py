"""Write Rerun recordings with sweeps, frames, boxes of actors, trajectories, path and scene."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO

import numpy as np

from lidarsim.columns.table import COLORS
from lidarsim.numerics.arrays import AnyArray, Bytes, Floats, Floats32
from lidarsim.packets.encoders import START_NS

from ..color_table import TURBO
from .cloud_format import CloudFormat
from .format_options import FormatOptions
from .frame_names import VEHICLE, WORLD
from .point_field import OMITTED, PointField
from .shown_sweeps import ActorBoxes, ShownSweep, Surroundings, SweepSequence

APPLICATION = "lidarpool"
SURVEY_TIME = "survey"  # timeline that starts with the survey
UTC_TIME = "utc"  # timeline for surveys with a date
_PIPE_BYTES = 1 << 20
_POINT_PIXELS = 1.5
_LINE_PIXELS = 1.5
_GRAY = (150, 150, 150)
_WHITE = (255, 255, 255)
_SCENE_ALPHA = 100  # translucent, so that points behind walls are visible (255 is opaque)
_ORANGE = (255, 153, 0)
_BLUE = (51, 153, 255)
_GREEN = (26, 204, 77)
# Limits of the color scale for log10(intensity) and for z in the sensor frame. They are the same
# for all sweeps.
_INTENSITY_LIMITS = (-3.0, 0.0)
_HEIGHT_LIMITS_M = (-3.0, 7.0)


class RRD(CloudFormat):
    """A Rerun recording of a survey, for the Rerun viewer.

    A recording contains these entities:

    - `map/base_link` and its sensors: poses over time.
    - `map/base_link/NAME/points`: points of each sweep with all columns, in the sensor frame at the
      start of the sweep.
    - `map/actors`: boxes of actors over time.
    - `map/scene`, `map/trajectories` and `map/path`: static scene, trajectories and planned path.

    Rerun stores positions as float32. World coordinates are therefore relative to the origin of the
    scene, which is stored in the recording property `origin`. Rerun adds unique identifiers to each
    file, so the bytes of two files are never the same.
    """

    title = "RRD"
    by_sweep = True
    frame = "sweep"
    fields = (
        PointField("colors", ("intensity",), "the height"),
        PointField("colors of surfaces", COLORS, OMITTED, on_request=True),
        PointField("class_ids", ("class",), OMITTED, if_named=True),
    )
    required = ("object",)
    actor_boxes = True

    def write(self, path: Path, spec: FormatOptions) -> None:
        """Write the recording."""
        surroundings = Surroundings.from_sweeps(self.sweeps, self.content())
        with _recording_to(path) as recording:
            log = RerunLog(recording)
            log.show_surroundings(surroundings)
            sequence = SweepSequence(self.sweeps)
            for sweep, points in enumerate(self.sweeps.points(self.cloud)):
                log.show_sweep(sequence.shown_sweep(sweep, points))


@contextmanager
def _recording_to(path: Path) -> Iterator[Any]:
    """Yield a recording that is written to a file.

    If the disk is full, Rerun's writer only logs an error and then blocks forever. Rerun therefore
    writes to a pipe, and a thread copies the data to the file.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    recording = import_module("rerun").RecordingStream(APPLICATION)  # optional dependency
    if not hasattr(os, "mkfifo"):  # Windows
        recording.save(path)
        yield recording
        recording.disconnect()
        return
    with (
        TemporaryDirectory(prefix="lidarpool-") as folder,
        ThreadPoolExecutor(1, "rrd") as thread,  # exiting waits for the thread
        path.open("wb") as file,
    ):
        pipe = Path(folder, "pipe")
        os.mkfifo(pipe)
        # Without O_NONBLOCK, opening the pipe would wait for a writer.
        source = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
        os.set_blocking(source, True)
        recording.save(pipe)
        copying = thread.submit(_copy, source, file)
        try:
            yield recording
        finally:
            recording.disconnect()  # closes the pipe
        copying.result()


def _copy(source: int, file: BinaryIO) -> None:
    """Copy a pipe to a file.

    After an error, the pipe is still read to its end, so that the writer does not block.
    """
    error: OSError | None = None
    with open(source, "rb", buffering=0) as pipe:
        while data := pipe.read(_PIPE_BYTES):
            if error is None:
                try:
                    file.write(data)
                    file.flush()
                except OSError as caught:
                    error = caught
    if error is not None:
        raise error


class RerunLog:
    """Logger of surroundings and sweeps to a Rerun recording."""

    def __init__(self, recording: Any) -> None:
        self._rr: Any = import_module("rerun")
        self._recording = recording
        recording.set_log_time_enabled(False)
        recording.set_log_tick_enabled(False)
        self._origin = np.zeros(3)
        self._start_ns = START_NS  # start of the survey
        self._has_classes = False
        self._log_static(WORLD, self._rr.ViewCoordinates.RIGHT_HAND_Z_UP)

    def show_surroundings(self, surroundings: Surroundings) -> None:
        """Log the scene, the trajectories and the path.

        Sweeps that are logged afterwards use the origin and the start time of these surroundings.
        """
        self._origin = surroundings.origin
        self._start_ns = surroundings.start_ns
        x, y, z = self._origin.tolist()
        self._recording.send_property("origin", self._rr.AnyValues(x=x, y=y, z=z))
        if surroundings.classes:
            self._has_classes = True
            names = [self._rr.AnnotationInfo(*item) for item in surroundings.classes.items()]
            self._log_static(WORLD, self._rr.AnnotationContext(names))
        if (surface := surroundings.surface) is not None:
            # Rerun only supports vertex normals, so each triangle gets its own vertices.
            corners = surface.vertices[surface.faces]
            colors = surface.colors
            mesh = self._rr.Mesh3D(
                vertex_positions=corners.reshape(-1, 3),
                vertex_normals=_normals(corners).repeat(3, axis=0),
                vertex_colors=None if colors is None else colors.repeat(3, axis=0),
                albedo_factor=(*(_GRAY if colors is None else _WHITE), _SCENE_ALPHA),
            )
            self._log_static(f"{WORLD}/scene", mesh)
        for name, positions in surroundings.trajectories.items():
            self._log_static(f"{WORLD}/trajectories/{name}", self._line(positions, _BLUE))
        if surroundings.path is not None:
            self.show_path(surroundings.path)

    def show_path(self, path: Floats) -> None:
        """Log a planned path, given its corners in world coordinates."""
        self._log_static(f"{WORLD}/path", self._line(path, _GREEN))

    def show_sweep(self, shown: ShownSweep) -> None:
        """Log the points, the frames and the actors' boxes of a sweep."""
        since_ns = np.timedelta64(shown.start_ns - self._start_ns, "ns")
        self._recording.set_time(SURVEY_TIME, duration=since_ns)
        if self._start_ns != START_NS:
            self._recording.set_time(UTC_TIME, timestamp=np.datetime64(shown.start_ns, "ns"))
        paths = {WORLD: WORLD}  # {frame: path of its entity}
        for transform in shown.transforms:
            if transform.parent == WORLD and transform.name not in (VEHICLE, shown.frame):
                continue  # actors are shown as boxes, which have their own poses
            path = paths[transform.name] = f"{paths[transform.parent]}/{transform.name}"
            in_world = transform.parent == WORLD
            position = transform.position - self._origin if in_world else transform.position
            pose = self._rr.Transform3D(
                translation=position, quaternion=self._rr.Quaternion(xyzw=transform.quaternion)
            )
            self._recording.log(path, pose)
        columns = dict(shown.columns)
        has_labels = self._has_classes and "class" in columns
        cloud = self._rr.Points3D(
            shown.positions,
            colors=_colors(shown.positions, columns),
            radii=self._rr.Radius.ui_points(_POINT_PIXELS),
            class_ids=columns["class"] if has_labels else None,  # labels only, colors are set
        )
        self._recording.log(f"{paths[shown.frame]}/points", cloud, self._rr.AnyValues(**columns))
        if shown.boxes is not None:
            self._recording.log(f"{WORLD}/actors", self._boxes(shown.boxes))

    def _log_static(self, path: str, archetype: Any) -> None:
        self._recording.log(path, archetype, static=True)

    def _line(self, positions: Floats, color: tuple[int, int, int]) -> Any:
        width = self._rr.Radius.ui_points(_LINE_PIXELS)
        return self._rr.LineStrips3D([positions - self._origin], colors=color, radii=width)

    def _boxes(self, boxes: ActorBoxes) -> Any:
        """Return an archetype with the boxes of the actors that are present."""
        rows = np.flatnonzero(boxes.present)
        return self._rr.Boxes3D(
            centers=boxes.centers[rows] - self._origin,
            half_sizes=boxes.sizes[rows] / 2,
            quaternions=boxes.quaternions[rows],
            labels=[boxes.names[row] for row in rows.tolist()],
            colors=[_ORANGE] * len(rows),
        )


def _normals(corners: Floats32) -> Floats32:
    """Return the unit normals of triangles, which are zero for degenerate triangles."""
    a, b, c = corners.swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)


def _colors(positions: Floats32, columns: dict[str, AnyArray]) -> Bytes:
    """Return the RGB colors of points.

    They are the colors in the columns, or are derived from the intensity or else the height.
    """
    if columns.keys() >= {*COLORS}:
        return np.stack([columns[name] for name in COLORS], axis=1)
    if "intensity" in columns:
        values = np.log10(np.maximum(columns["intensity"], 1e-9))
        limits = _INTENSITY_LIMITS
    else:
        values = positions[:, 2]
        limits = _HEIGHT_LIMITS_M
    fractions = np.clip((values - limits[0]) / (limits[1] - limits[0]), 0, 1)
    table = np.round(TURBO * 255).astype(np.uint8)
    return table[(fractions * (len(table) - 1)).astype(np.intp)]
