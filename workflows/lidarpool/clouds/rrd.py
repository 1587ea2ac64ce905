"""Recordings of Rerun: clouds, frames, boxes of actors, trajectories, path and scene over time."""

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

from lidarsim.base.arrays import AnyArray, Bytes, Floats, Floats32
from lidarsim.columns.table import COLORS
from lidarsim.packets.encoders import START_NS
from lidarview.render.coloring import TURBO

from .cloud_format import CloudFormat
from .frame_names import CARRIER, WORLD
from .shown_sweeps import ActorBoxes, ShownSweep, Surroundings, SweepSequence
from .writing import ExportSpec

APPLICATION = "lidarpool"
SURVEY_TIME = "survey"  # timeline: since the survey's start
UTC_TIME = "utc"  # timeline of surveys with a date
_PIPE_BYTES = 1 << 20
_POINT_PIXELS = 1.5
_LINE_PIXELS = 1.5
_GRAY = (150, 150, 150)
_WHITE = (255, 255, 255)
_SCENE_ALPHA = 100  # 255 is opaque; points on a surface, and behind a wall, can be seen
_ORANGE = (255, 153, 0)
_BLUE = (51, 153, 255)
_GREEN = (26, 204, 77)
# Limits of the color scale, the same in all sweeps: log10 of intensity, and z in the sensor frame.
_INTENSITY_LIMITS = (-3.0, 0.0)
_HEIGHT_LIMITS_M = (-3.0, 7.0)


class Rerun(CloudFormat):
    """A recording of Rerun, with scene and planned path of the pictures' content.

    Points are at `map/base_link/NAME/points`, in the sensor frame at the start of their sweep, with
    all columns; `map/base_link` and its sensors have their poses over time. The boxes of actors are
    `map/actors`; `map/scene`, `map/trajectories` and `map/path` do not change. Positions are
    float32 in Rerun, so those in the world are relative to the scene's local origin, which the
    recording's property `origin` holds. Rerun's own identifiers make the bytes of each file unique.
    """

    title = "RRD"
    by_sweep = True
    frame = "sweep"
    required = ("object",)
    actor_boxes = True

    def write(self, path: Path, spec: ExportSpec) -> None:
        """Write the recording."""
        surroundings = Surroundings.from_sweeps(self.sweeps, self.content())
        with _recording_to(path) as recording:
            log = RerunLog(recording)
            log.show_surroundings(surroundings)
            sequence = SweepSequence(self.sweeps)
            for sweep, points in enumerate(self.sweeps.points(self.cloud)):
                log.show_sweep(sequence.show(sweep, points))


@contextmanager
def _recording_to(path: Path) -> Iterator[Any]:
    """Yield a recording that is written to a file.

    Raises OSError if the file cannot be written.

    Rerun's own writer logs the error of a full disk, and waits for ever. So it writes to a pipe,
    and a thread copies the pipe to the file.
    """
    recording = import_module("rerun").RecordingStream(APPLICATION)  # an extra
    if not hasattr(os, "mkfifo"):  # Windows
        recording.save(path)
        yield recording
        recording.disconnect()
        return
    with (
        TemporaryDirectory(prefix="lidarpool-") as folder,
        ThreadPoolExecutor(1, "rrd") as thread,  # waits for the thread
        path.open("wb") as file,
    ):
        pipe = Path(folder, "pipe")
        os.mkfifo(pipe)
        source = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)  # else opening waits for a writer
        os.set_blocking(source, True)
        recording.save(pipe)
        copying = thread.submit(_copy, source, file)
        try:
            yield recording
        finally:
            recording.disconnect()  # the end of the pipe
        copying.result()


def _copy(source: int, file: BinaryIO) -> None:
    """Copy a pipe to a file.

    After an error, read on to the end, so that no writer waits.
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
    """Logs surroundings and sweeps to a recording of Rerun."""

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
        """Log scene, trajectories and path, and take the origin and the start of the survey."""
        self._origin = surroundings.origin
        self._start_ns = surroundings.start_ns
        x, y, z = self._origin.tolist()
        self._recording.send_property("origin", self._rr.AnyValues(x=x, y=y, z=z))
        if surroundings.classes:
            self._has_classes = True
            names = [self._rr.AnnotationInfo(*item) for item in surroundings.classes.items()]
            self._log_static(WORLD, self._rr.AnnotationContext(names))
        if (surface := surroundings.surface) is not None:
            corners = surface.vertices[surface.faces]  # Rerun shades by the normals of vertices
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
        """Log a planned path, (w, 3), meters, world coordinates."""
        self._log_static(f"{WORLD}/path", self._line(path, _GREEN))

    def show_sweep(self, shown: ShownSweep) -> None:
        """Log the points of a sweep, its frames and its boxes of actors."""
        since_ns = np.timedelta64(shown.start_ns - self._start_ns, "ns")
        self._recording.set_time(SURVEY_TIME, duration=since_ns)
        if self._start_ns != START_NS:
            self._recording.set_time(UTC_TIME, timestamp=np.datetime64(shown.start_ns, "ns"))
        paths = {WORLD: WORLD}  # {frame: path of its entity}
        for transform in shown.transforms:
            if transform.parent == WORLD and transform.name not in (CARRIER, shown.frame):
                continue  # frame of an actor, whose box has a separate pose
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
            class_ids=columns["class"] if has_labels else None,  # names, since there are colors
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
        """Return the boxes of the actors that are present."""
        rows = np.flatnonzero(boxes.present)
        return self._rr.Boxes3D(
            centers=boxes.centers[rows] - self._origin,
            half_sizes=boxes.sizes[rows] / 2,
            quaternions=boxes.quaternions[rows],
            labels=[boxes.names[row] for row in rows.tolist()],
            colors=[_ORANGE] * len(rows),
        )


def _normals(corners: Floats32) -> Floats32:
    """Return the unit normals (f, 3) of triangles (f, 3, 3), zero for triangles without area."""
    a, b, c = corners.swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)


def _colors(positions: Floats32, columns: dict[str, AnyArray]) -> Bytes:
    """Return colors (n, 3) of points: their own, or of their intensity, or of their height."""
    if columns.keys() >= {*COLORS}:
        return np.stack([columns[name] for name in COLORS], axis=1)
    if "intensity" in columns:
        values = np.log10(np.maximum(columns["intensity"], 1e-9))
        limits = _INTENSITY_LIMITS
    else:
        values = positions[:, 2]
        limits = _HEIGHT_LIMITS_M
    shares = np.clip((values - limits[0]) / (limits[1] - limits[0]), 0, 1)
    table = np.round(TURBO * 255).astype(np.uint8)
    return table[(shares * (len(table) - 1)).astype(np.intp)]
