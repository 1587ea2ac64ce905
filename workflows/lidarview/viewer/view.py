"""Answer the requests of the page that shows a survey or a cloud."""

from __future__ import annotations

import math
import shutil
import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from lidarfiles.picture_file import MAX_POSITIONS, PictureContent, SensorPositions, moving_positions
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.ply_format import AXES
from lidarsim.columns.table import AXES as POSITION
from lidarsim.columns.table import (
    CAUSES,
    NO_SURFACE,
    OBJECT,
    TABLE,
    Column,
    X,
    Y,
    Z,
    names_by_value,
)
from lidarsim.errors import LidarError
from lidarsim.motion.trajectory import presence_ns
from lidarsim.numerics.arrays import AnyArray, Floats, Floats32
from lidarsim.scene.actors import Actor, distinct_meshes, samples_per_actor
from lidarsim.scene.colors import as_bytes
from lidarsim.sweeps.sweeps import Sweeps
from raybeam import RayCaster

from ..render.closeup import floor_and_cut_heights, surrounding_box
from ..render.coloring import (
    MAX_UNNAMED_LABELS,
    Coloring,
    add_composed_columns,
    column_values,
    label_text,
    make_coloring,
)
from ..render.surface import golden_spiral
from ..render.theme import object_colors
from .display_mesh import HITS_SAMPLE, MAX_TRIANGLES, DisplayMesh, available_colorings
from .legends import Legend, make_legend
from .point_selection import (
    BLOCK_ROWS,
    RESULT,
    STATION,
    BrowserCamera,
    ClientDisconnected,
    InMemoryPoints,
    PointFilter,
    PointFinder,
    Points,
    ScanOrderedPoints,
    ScanRanges,
    StationPoints,
    box_corners,
    parse_scans,
    read_positions,
)
from .range_pictures import range_image, surround_object
from .server import Answer, Arguments

MAX_POINTS = 20_000_000  # maximum number of points in an answer or a download
MAX_RAYS = 150  # more rays would hide the surfaces
_SAMPLE = 100_000  # number of points for estimating color scales and limits
_MAX_COUNTED = 20_000_000  # with more points, the labels are counted in a sample
_CORNERS = 200  # directions in which the first view shows the outermost point of a cloud
_MAX_BEYOND = 0.5  # minimum distance of outliers from the central 99 % range, as a fraction of it
_MAX_COLORINGS = 64  # number of color scales that are kept
_MAX_NAMES = 2000  # maximum number of named values that a menu of the page lists
_NS = 1e9
IN_SENSOR_AXES = "The points are in sensor coordinates, so the scene is not shown."
CLOUD = "cloud.ply"


@dataclass(frozen=True)
class DownloadFormats:
    """File formats that a page offers for downloading points."""

    formats: Sequence[str]  # file extensions without a dot, such as "las"
    save: Callable[[Cloud, Path], object]  # writes points in the format of the path's extension


@dataclass(frozen=True, eq=False)
class LabeledObject:
    """Labeled object of a recording, which is shown as a box with its name."""

    name: str
    size: Floats  # (3,), length, width and height in meters
    times_ns: Floats  # (k,), nanoseconds since the start of the recording
    positions: Floats  # (k, 3), centers of the box in the coordinates of the points, meters
    quaternions: Floats  # (k, 4)
    presence_ns: tuple[float, float]  # times between which it is shown


@dataclass(eq=False)
class View:
    """A survey, or a cloud without a survey, as shown by a page.

    The page receives local coordinates, which are world coordinates minus `origin`. The scene is
    omitted if the points are in the sensor frame.
    """

    points: Points
    pictured: PictureContent | None = None  # scene, sensors, sample rays, and hit counts
    sweeps: Sweeps | None = None  # poses and scans of all sweeps
    note: str = ""  # note for the user
    title: str = "lidarpool"
    results: Sequence[str] = ()  # names of the results if there are several
    # Function that returns the current hits on each triangle during a run, with the actors'
    # triangles last. If None, the hits are `pictured.hit_counts`.
    read_hit_counts: Callable[[], AnyArray] | None = None
    triangles: int = MAX_TRIANGLES  # maximum number of displayed triangles
    downloads: DownloadFormats | None = None  # None if points cannot be downloaded
    # {column: names of the values 0, 1, 2, …}, in addition to those of the scene and the sweeps
    names: Mapping[str, Sequence[str]] = field(default_factory=dict)
    preview: bool = False  # whether the points come from the first sweeps, before a run
    stated_epsg: int | None = None  # EPSG code in the point cloud file
    labeled_objects: Sequence[LabeledObject] = ()

    def __post_init__(self) -> None:
        self.version = 0  # number of times that the points have been replaced
        # (n, 2, 3) start and end points of sample rays, local, in meters
        self.rays: Floats32 = np.zeros((0, 2, 3), np.float32)
        self.path: Floats | None = None  # (w, 2) corners of the planned path, local, in meters
        sources = (source for source in (self.pictured, self.sweeps) if source is not None)
        if any(source.coordinates != "world" for source in sources):
            self.note = f"{self.note} {IN_SENSOR_AXES}".strip()
        if self.sweeps is not None and self.sweeps.coordinates != "world":
            self.pictured = None
        if (pictured := self.pictured) is not None:
            self.rays = pictured.sample_rays
            if pictured.planning is not None and pictured.planning.best is not None:
                self.path = pictured.planning.best.corners
        self.origin, self._bounds, self._corners = self._extent()
        self._lock = threading.Lock()
        self._surface: DisplayMesh | None = None
        self._range_limits: dict[int, tuple[float, float]] = {}  # color scale of each sensor
        self._label_counts_of: dict[tuple[str, int], dict[str, Any]] = {}  # the latest answer
        self.replace_points(self.points)

    def replace_points(self, points: Points, *, keep_scales: bool = False) -> None:
        """Replace the points, optionally keeping the color scales of the previous points."""
        self.points = points
        self._finder = PointFinder(self._with_stations(points), self.origin)
        other_columns = {
            column.name: column for column in self._finder.points.table if column not in POSITION
        }
        self.columns = {"z": Z, "x": X, "y": Y, **other_columns}  # columns to color and filter by
        self._colored = add_composed_columns(self.columns)
        if not keep_scales:
            # {(column, filter, limits of the scale): color scale}
            self._colorings: dict[tuple[Any, ...], Coloring] = {}
        self.version += 1

    def _with_stations(self, points: Points) -> Points:
        """Add a station column to the points if the survey has several stations."""
        sweeps = self.sweeps
        names = [column.name for column in points.table]
        if sweeps is None or not sweeps.station_numbers.any() or "scan" not in names:
            return points
        if isinstance(points, StationPoints) or STATION.name in names:
            return points
        return StationPoints(points, sweeps.scans[:-1], sweeps.station_numbers)

    @property
    def shown_points(self) -> Points:
        """Points with all columns that the page displays."""
        return self._finder.points

    # -- properties of the survey ---------------------------------------------------------

    @cached_property
    def sensors(self) -> Sequence[SensorPositions]:
        """Positions of the sensors in local coordinates.

        The positions come from the plot file if there is one, and otherwise from the starts of the
        sweeps. In the latter case, a sensor is considered moving if it has at least three sweeps
        and a new position in more than half of them.
        """
        if self.pictured is not None:
            return self.pictured.sensors
        sweeps = self.sweeps
        if sweeps is None:
            return ()
        sensors: list[SensorPositions] = []
        for number, name in enumerate(sweeps.sensors):
            of_sensor = sweeps.sensor == number
            local = sweeps.pose.positions[of_sensor] - self.origin
            if sweeps.coordinates != "world":  # the sensor is the origin of its points
                local = np.zeros_like(local)
            is_standing = bool(sweeps.station_numbers.any())
            moves = not is_standing and len(np.unique(local, axis=0)) > len(local) / 2 > 1
            sensors.append(SensorPositions(sweeps.begins_ns[of_sensor], local, moves, name))
        return sensors

    @property
    def epsg(self) -> int | None:
        """EPSG code that the survey or the file states for the coordinates, or None."""
        sweeps = self.sweeps
        if sweeps is None:
            return self.stated_epsg
        if sweeps.coordinates != "world":
            return None
        return self.stated_epsg if sweeps.epsg is None else sweeps.epsg

    @property
    def actors(self) -> Sequence[Actor]:
        """Actors of the scene."""
        return () if self.pictured is None else self.pictured.scene.actors

    @property
    def duration_ns(self) -> float:
        """Duration of the survey in nanoseconds, or 0 if unknown."""
        if self.pictured is not None and self.pictured.duration_ns:
            return self.pictured.duration_ns
        if self.sweeps is None or not len(self.sweeps):
            return 0.0
        ends = []
        for sensor in range(len(self.sweeps.sensors)):
            starts = np.unique(self.sweeps.begins_ns[self.sweeps.sensor == sensor])
            if len(starts):
                ends.append(starts[-1] + (np.diff(starts).min() if len(starts) > 1 else 0))
        return float(max(ends))

    @property
    def _station_names(self) -> Sequence[str]:
        """Names of the stations 1, 2, … after an empty name for 0.

        The sequence is empty without stations.
        """
        if self.sweeps is None or not self.sweeps.station_numbers.any():
            return ()
        names = self.names.get(STATION.name) or [""] * (1 + self.sweeps.station_numbers.max())
        return ["", *(name or f"station {k}" for k, name in enumerate(names[1:], 1))]

    def _names(self, column: str) -> Sequence[str]:
        """Return the names of the values 0, 1, 2, … in a column.

        The sequence is empty if the values have no names.
        """
        if column == RESULT.name and self.results:
            return self.results
        if column == STATION.name:
            return self._station_names
        if column in self.names:
            return self.names[column]
        if self.pictured is not None and column in self.columns:
            return self.pictured.names_of(self.columns[column])
        if (sweeps := self.sweeps) is not None:
            names: dict[str, Sequence[str]] = {
                "sensor": sweeps.sensors,
                "object": (*sweeps.objects, *sweeps.actors),
                "class": names_by_value(sweeps.classes),
                "material": sweeps.materials,
            }
            if column in names:
                return names[column]
        return CAUSES if self.columns.get(column) == TABLE["cause"] else ()

    def _extent(self) -> tuple[Floats, Floats, Floats]:
        """Return the local origin, the bounding box, and the points that the first view must show.

        The origin (3,) is in world coordinates, and the box (2, 3) and the points (k, 3) are local.
        The points are the corners of the scene, the ends of a planned path, and the sensor
        positions unless the sensors surround an object. They fit the image more tightly than the
        corners of the box, which is mostly empty if the sensors surround an object.
        """
        if self.pictured is None:
            return _cloud_extent(self.points)
        scene = self.pictured.scene
        planning = self.pictured.planning
        sensors = np.concatenate([np.empty((0, 3)), *(s.positions for s in self.pictured.sensors)])
        corners = box_corners(scene.bounds)
        if planning is not None:
            level = corners[:, 2].min()
            corners = np.vstack([corners, [*planning.start, level], [*planning.target, level]])
        all_corners = np.vstack([corners, sensors])
        if not surround_object(sensors, scene.bounds):
            corners = all_corners
        return scene.origin, np.stack([all_corners.min(axis=0), all_corners.max(axis=0)]), corners

    # -- answers -------------------------------------------------------------------------

    def answer(
        self, question: str, arguments: Arguments, is_disconnected: Callable[[], bool]
    ) -> Answer:
        """Answer a request of the page.

        Parameters
        ----------
        question
            Name of the request: "state", "points", "point", "column", "counts", "surface", "range",
            or "export".
        arguments
            Arguments in the query of the URL.
        is_disconnected
            Returns True once the client has disconnected. The search for points then raises
            `ClientDisconnected`.

        Returns
        -------
        header
            Content that is sent as JSON.
        arrays
            Arrays by name.
        """
        answers: Mapping[str, Callable[[Arguments, Callable[[], bool]], Answer]] = {
            "state": lambda *_: self._state(),
            "points": self._points,
            "point": lambda arguments, _: self._point(int(arguments["row"])),
            "column": lambda arguments, _: self._column(arguments["name"]),
            "counts": lambda arguments, gone: self._label_counts(arguments["name"], gone),
            "surface": lambda arguments, _: self._scene(arguments["color"]),
            "range": lambda arguments, _: self._range(int(arguments["sweep"])),
            "export": self._export,
        }
        return answers[question](arguments, is_disconnected)

    def _state(self) -> Answer:
        """Return a description of the view without points and surfaces.

        In the header, "bounds" is a box around the scene, the sensors, and the ends of a planned
        path, and "box" is the part to show first. In a large scene, this is the surroundings of the
        trajectories, and "cut" is the local z of the top of the box. Lengths are in meters and
        times in seconds.
        """
        # None if the page shows the whole scene.
        shown_box = surrounding_box(
            self._bounds, moving_positions(self.sensors, self.actors, self.duration_ns)
        )
        box = self._bounds if shown_box is None else shown_box
        corners = self._corners if shown_box is None else box_corners(shown_box)
        arrays: dict[str, AnyArray] = {"rays": self.displayed_rays, "corners": corners}
        for number, sensor in enumerate(self.sensors):
            arrays[f"sensor{number}_times"] = sensor.times_ns / _NS
            arrays[f"sensor{number}_places"] = sensor.positions
        arrays |= self._actor_arrays()
        arrays |= self._box_arrays()
        sweeps = self.sweeps
        if sweeps is not None:
            arrays["sweep_scans"] = sweeps.scans.astype(np.float64)
            arrays["sweep_begins"] = sweeps.begins_ns / _NS
            arrays["sweep_sensor"] = sweeps.sensor
            arrays["sweep_station"] = sweeps.station_numbers.astype(np.int32)
        pictured = self.pictured
        objects = self._names("object") if pictured is None else pictured.scene.object_names
        object_count = len(objects)
        static_count = object_count - len(self.actors)
        classes = self._classes_of_objects()
        result_numbers = np.arange(len(self.results))
        header = {
            "title": self.title,
            "version": self.version,
            "points": len(self.points),
            "columns": [
                {
                    "name": name,
                    "unit": "s" if column.unit == "ns" else column.unit,
                    "meaning": column.meaning,
                }
                for name, column in self.columns.items()
            ],
            "colors": [*self._colored],
            "origin": self.origin.tolist(),
            "epsg": self.epsg,
            "box": box.tolist(),
            "bounds": self._bounds.tolist(),
            "cut": None if shown_box is None else float(shown_box[1, 2]),
            "scene_colors": pictured
            and available_colorings(pictured.scene, pictured.reflectance, pictured.face_materials),
            "sensors": [
                {
                    "name": sensor.name,
                    "model": sensor.model,
                    "moves": sensor.moves,
                    "labels": sensor.labels,
                }
                for sensor in self.sensors
            ],
            "actors": [
                {"name": actor.name, "class": classes.get(number)}
                for number, actor in enumerate(self.actors, static_count)
            ],
            "labeled": [{"name": labeled.name} for labeled in self.labeled_objects],
            "classes": {str(k): name for k, name in enumerate(self._names("class")) if name},
            # With actors, the page selects times instead of stations.
            "stations": [] if self.actors else self._station_names,
            "results": make_legend(make_coloring(result_numbers, RESULT, self.results))["labels"],
            "exports": self._export_formats,
            "actor_colors": as_bytes(object_colors(object_count))[static_count:].tolist(),
            "labeled_colors": as_bytes(object_colors(len(self.labeled_objects))).tolist(),
            "statics": static_count,
            "duration": self.duration_ns / _NS,
            "path": self.planned_path,
            "note": self.note,
            "preview": self.preview,
            # Sweeps in sensor coordinates do not fit together, so they are shown one at a time.
            "by_sweep": sweeps is not None and sweeps.coordinates != "world" and len(sweeps) > 1,
        }
        return header, arrays

    def _actor_arrays(self) -> dict[str, AnyArray]:
        """Return the meshes and trajectories of the actors.

        Distinct meshes are numbered ``mesh0``, ``mesh1``, …. An animated mesh has the vertices (p,
        v, 3) of each pose. Its actors have the fractional pose number at each time
        (``actor0_frames``). Coordinates are local, and times are in seconds.
        """
        meshes, mesh_indices = distinct_meshes(actor.mesh for actor in self.actors)
        arrays: dict[str, AnyArray] = {
            "actor_mesh": mesh_indices.astype(np.int32)
        }  # browsers lack int64 arrays
        for k, mesh in enumerate(meshes):
            arrays[f"mesh{k}_corners"] = mesh.vertices[mesh.faces].astype(np.float32)
            if mesh.colors is not None:  # repeated for each corner
                arrays[f"mesh{k}_colors"] = mesh.colors.mean_colors().repeat(3, axis=0)
            if mesh.animation is not None:
                arrays[f"mesh{k}_poses"] = mesh.animation.vertices.astype(np.float32)
                arrays[f"mesh{k}_faces"] = mesh.faces.astype(np.int32)
        sample_count = samples_per_actor(self.actors, MAX_POSITIONS)
        for k, actor in enumerate(self.actors):
            times, positions, rotations = actor.samples(self.duration_ns, sample_count)
            arrays |= {f"actor{k}_times": times / _NS, f"actor{k}_places": positions}
            arrays[f"actor{k}_turns"] = rotations
            arrays[f"actor{k}_there"] = np.array(presence_ns(actor.trajectory)) / _NS
            if (animation := actor.mesh.animation) is not None:
                # The page repeats all animations. If an animation ends instead, the pose numbers
                # stay just below the last pose.
                pose_numbers = actor.seconds(times)[0] / animation.step_s
                last = len(animation.vertices) - 1 - 1e-6
                arrays[f"actor{k}_frames"] = (
                    pose_numbers if animation.repeat else pose_numbers.clip(0, last)
                )
        return arrays

    def _box_arrays(self) -> dict[str, AnyArray]:
        """Return the sizes and the poses of labeled objects, like those of actors."""
        arrays: dict[str, AnyArray] = {}
        for k, labeled in enumerate(self.labeled_objects):
            arrays[f"labeled{k}_size"] = labeled.size
            arrays[f"labeled{k}_times"] = labeled.times_ns / _NS
            arrays[f"labeled{k}_places"] = labeled.positions - self.origin
            arrays[f"labeled{k}_turns"] = labeled.quaternions
            arrays[f"labeled{k}_there"] = np.array(labeled.presence_ns) / _NS
        return arrays

    @property
    def displayed_rays(self) -> Floats32:
        """Local start and end points of at most `MAX_RAYS` sample rays.

        The shape is (n, 2, 3).
        """
        return self.rays[:: len(self.rays) // MAX_RAYS + 1]

    @property
    def planned_path(self) -> dict[str, Any] | None:
        """Corners of the planned path, and obstacles as discs.

        The value is None if there is no path. A disc is (x, y, radius). All values are local, in
        meters.
        """
        planning = None if self.pictured is None else self.pictured.planning
        if self.path is None or planning is None:
            return None
        discs = np.column_stack([planning.centers, planning.radii])
        return {"corners": self.path.tolist(), "discs": discs.tolist()}

    def _classes_of_objects(self) -> dict[int, int]:
        """Return the class of each object.

        If it is not stated, it is taken from one of the object's points in a sample.
        """
        if not {"object", "class"} <= self.columns.keys():
            return {}
        if self.pictured is not None and self.pictured.object_classes is not None:
            return dict(enumerate(self.pictured.object_classes.tolist()))
        rows, _ = self._finder.find_points(_SAMPLE)
        columns = (self.points.values(name, rows).tolist() for name in ("object", "class"))
        return dict(zip(*columns, strict=True))

    def _export(self, arguments: Arguments, is_disconnected: Callable[[], bool]) -> Answer:
        """Export the points that pass a filter as a file.

        If the format consists of several files, the answer is a ZIP archive. If there are too many
        points, or if the format cannot store them, the answer contains an error instead.
        """
        ending = arguments["format"]
        if self.downloads is None or ending not in self._export_formats:
            raise KeyError(ending)
        points = self.points
        sweeps = self.sweeps
        rows, count = self._finder.find_points(
            MAX_POINTS, *self._read_selection(arguments), None, is_disconnected
        )
        if count > MAX_POINTS:
            message = f"The selection has {count:,} points; the limit is {MAX_POINTS:,}. Filter or"
            return {"error": f"{message} clip the points, or use `lidarpool export`."}, {}
        columns = {column.name: points.values(column.name, rows) for column in points.table}
        world_positions = np.stack([points.values(axis, rows) for axis in AXES], axis=1)
        extra_columns = tuple(column for column in points.table if column.name not in TABLE)
        cloud = Cloud(
            world_positions, columns, extra_columns, None if sweeps is None else lambda: sweeps
        )
        with TemporaryDirectory(prefix="lidarpool-") as folder:
            path = Path(folder) / f"cloud.{ending}"
            try:
                self.downloads.save(cloud, path)
            except LidarError as error:
                return {"error": str(error)}, {}
            name = path.name
            if path.is_dir():
                file, *other_files = path.iterdir()
                path = Path(shutil.make_archive(str(path), "zip", path)) if other_files else file
                name = path.name if other_files else name
            return {"name": name}, {"file": np.fromfile(path, np.uint8)}

    @property
    def _export_formats(self) -> Sequence[str]:
        """Formats offered for download.

        There are none if the points are a sample or a preview.
        """
        is_sample = isinstance(self.points, InMemoryPoints) and not isinstance(
            self.points, ScanOrderedPoints
        )
        if self.downloads is None or is_sample or self.preview:
            return ()
        return self.downloads.formats

    def _read_selection(self, arguments: Arguments) -> tuple[PointFilter, ScanRanges | None]:
        """Parse the filter and the ranges of scans in a request's arguments."""
        point_filter = PointFilter.parse(arguments.get("filter", ""), list(self.columns))
        return point_filter, parse_scans(arguments["scans"]) if "scans" in arguments else None

    def _points(self, arguments: Arguments, is_disconnected: Callable[[], bool]) -> Answer:
        """Return points with their colors.

        The points can be restricted by a filter, ranges of scans, and a camera. Positions are
        local, and "rows" are row indices. "count" is the number of points that pass the filter
        before they are thinned out.
        """
        finder = self._finder
        version = self.version
        selection = self._read_selection(arguments)
        name = arguments["color"]
        column = self._colored[name]
        camera = BrowserCamera.parse(arguments["eye"]) if "eye" in arguments else None
        max_points = max(1, min(int(arguments["most"]), MAX_POINTS))
        rows, count = finder.find_points(max_points, *selection, camera, is_disconnected)
        limits = _read_limits(arguments["limits"]) if "limits" in arguments else None
        coloring = self._coloring(
            finder, name, selection[0].without_column(name), limits, is_disconnected
        )
        values = column_values(column, lambda column_name: finder.points.values(column_name, rows))
        colors = np.full((len(rows), 4), 255, np.uint8)
        colors[:, :3] = as_bytes(coloring.paint(values))
        arrays: dict[str, AnyArray] = {
            "positions": (read_positions(finder.points, rows) - self.origin).astype(np.float32),
            "colors": colors,
            "rows": rows.astype(np.uint32),
        }
        legend: Legend | None = None
        if len(finder.points):
            legend = make_legend(coloring) | {"column": name, "meaning": column.meaning}
        return {"version": version, "count": count, "legend": legend}, arrays

    def coloring(self, name: str) -> Coloring:
        """Return the color scale of a column for all points."""
        return self._coloring(self._finder, name, PointFilter(), None, _never_disconnected)

    def _coloring(
        self,
        finder: PointFinder,
        name: str,
        point_filter: PointFilter,
        limits: tuple[float, float] | None,
        is_disconnected: Callable[[], bool],
    ) -> Coloring:
        """Return the color scale of a column for the points that pass a filter.

        If no limits are given, they are estimated from a sample. The scale is the same for all
        scans.
        """
        colorings = self._colorings
        coloring = colorings.get((name, point_filter, limits))
        if coloring is None:
            rows, _ = finder.find_points(_SAMPLE, point_filter, None, None, is_disconnected)
            column = self._colored[name]
            values = column_values(
                column, lambda column_name: finder.points.values(column_name, rows)
            )
            coloring = make_coloring(values, column, self._names(name), limits)
            with self._lock:
                while len(colorings) >= _MAX_COLORINGS:
                    del colorings[next(iter(colorings))]  # the oldest
                colorings[name, point_filter, limits] = coloring
        return coloring

    def _column(self, name: str) -> Answer:
        """Return the limits or the labels of a column for the page's filters."""
        column = self.columns[name]
        values = self._finder.points.values(name, self._finder.find_points(_SAMPLE)[0])
        values = values[np.isfinite(values)]
        names = self._names(name)
        distinct = np.unique(values)
        is_short = len(distinct) <= (_MAX_NAMES if names else MAX_UNNAMED_LABELS) and name != "scan"
        if column.kind == "label" and len(distinct) and is_short:
            labels = [
                [label_text(value, column, names), value]
                for value in distinct.astype(np.int64).tolist()
            ]
            return {"labels": labels}, {}
        unit = _NS if column.unit == "ns" else 1.0
        lower, upper = (float(distinct[0]), float(distinct[-1])) if len(distinct) else (0.0, 1.0)
        is_integer = values.dtype.kind in "iu" and unit == 1.0
        return {"low": lower / unit, "high": upper / unit, "unit": unit, "whole": is_integer}, {}

    def _label_counts(self, name: str, is_disconnected: Callable[[], bool]) -> Answer:
        """Count the points with each value of a label column.

        If there are many points, the numbers are estimated from a sample, and "exact" is False.
        """
        if self.columns[name].kind != "label":
            raise KeyError(name)
        finder = self._finder
        key = (name, self.version)
        if key not in self._label_counts_of:
            total = len(finder.points)
            is_exact = total <= _MAX_COUNTED
            counts = Counter[int]()
            if is_exact:
                for start in range(0, total, BLOCK_ROWS):
                    if is_disconnected():
                        raise ClientDisconnected
                    _add_counts(
                        counts, finder.points.values(name, slice(start, start + BLOCK_ROWS))
                    )
            else:
                rows, _ = finder.find_points(_SAMPLE)
                _add_counts(counts, finder.points.values(name, rows))
                scale = total / max(len(rows), 1)
                counts = Counter({value: round(scale * n) for value, n in counts.items()})
            self._label_counts_of = {key: {"counts": sorted(counts.items()), "exact": is_exact}}
        return self._label_counts_of[key], {}

    def _point(self, row: int) -> Answer:
        """Return the world position of a point, and all of its columns as text."""
        points = self.shown_points
        if not 0 <= row < len(points):
            raise KeyError(row)
        rows = np.array([row])
        shown = [
            [column.name, self._in_words(column, points.values(column.name, rows)[0])]
            for column in self.columns.values()
            if column not in POSITION
        ]
        position = [float(points.values(axis, rows)[0]) for axis in AXES]
        return {"place": position, "columns": shown}, {}

    def _in_words(self, column: Column, value: Any) -> str:
        """Format a column value as text with its unit."""
        names = self._names(column.name)
        if column == OBJECT and value < 0:
            return NO_SURFACE
        if column.kind == "label" and 0 <= value < len(names):
            return names[int(value)] or str(value)
        if column.unit == "ns":
            return f"{int(value) / 1e9:.9f} s"
        number = f"{value:.6g}" if np.issubdtype(type(value), np.floating) else f"{value}"
        return f"{number} {column.unit}".rstrip()

    def _scene(self, color: str) -> Answer:
        """Return the static triangles of the scene in their colors.

        `color` is one of the `available_colorings`. The header contains the legend, the height of
        the floor, and the height at which a roof is cut off.
        """
        pictured = self.pictured
        if pictured is None:
            raise KeyError("surface")
        with self._lock:  # simplifying may take long, so only the first request does it
            surface = self._surface = self._surface or DisplayMesh(
                pictured.scene,
                pictured.reflectance,
                self.triangles,
                pictured.face_materials,
                pictured.materials or (),
            )
        hit_counts = pictured.hit_counts
        hit_points = np.zeros((0, 3), np.float32)
        if color == "hits":
            hit_counts = hit_counts if self.read_hit_counts is None else self.read_hit_counts()
            if not len(hit_counts):  # the run has not started
                hit_counts = np.zeros(len(pictured.scene.faces), np.int64)
            hit_counts = hit_counts[: len(pictured.scene.faces)]  # without actors' triangles
            rows, _ = self._finder.find_points(HITS_SAMPLE)
            if "object" in self.columns:  # only points on static objects
                owners = self._finder.points.values("object", rows)
                rows = rows[(owners >= 0) & (owners < len(pictured.scene.names))]
            hit_points = (read_positions(self._finder.points, rows) - self.origin).astype(
                np.float32
            )
        arrays, legend = surface.color_by(color, hit_counts, hit_points)
        return {"legend": legend} | self._floor_and_roof_cut, arrays

    @cached_property
    def _floor_and_roof_cut(self) -> dict[str, float | None]:
        """Local floor height below the sensors, and height of a cut that removes the roof.

        Each height is None without sensors, floor, or roof. `_surface` must be set before.
        """
        surface = self._surface
        pictured = self.pictured
        poses = [sensor.positions for sensor in self.sensors if len(sensor.positions)]
        if surface is None or pictured is None or not poses:
            return {"floor": None, "roof_cut": None}
        scene = surface.coarse
        caster = RayCaster(scene.vertices, scene.faces)
        floor, cut = floor_and_cut_heights(scene, caster, np.concatenate(poses))
        return {"floor": floor, "roof_cut": cut}

    def _range(self, sweep: int) -> Answer:
        """Return the range image of a sweep, as drawn by `range_image`.

        "low" and "high" are the ends of the color scale in meters, which all sweeps of a sensor
        share.
        """
        sweeps = self.sweeps
        finder = self._finder
        if sweeps is None or not 0 <= sweep < len(sweeps):
            raise KeyError(sweep)
        first_scan, next_scan = (int(scan) for scan in sweeps.scans[sweep : sweep + 2])
        rows, _ = finder.find_points(MAX_POINTS, scans=((first_scan, next_scan - 1),))
        image = np.zeros((1, 1, 4), np.uint8)
        limits = (0.0, 1.0)
        sensor = int(sweeps.sensor[sweep])
        if len(rows):
            local = sweeps.in_sensor(sweep, read_positions(finder.points, rows))
            channels = None
            if "channel" in self.columns:
                channels = finder.points.values("channel", rows).astype(np.int64)
            ranges = np.linalg.norm(local, axis=1)
            if sensor not in self._range_limits:  # all sweeps of a sensor share a scale
                lower, upper = np.percentile(ranges, [1, 99])
                self._range_limits[sensor] = float(lower), float(upper)
            limits = self._range_limits[sensor]
            image = range_image(local, ranges, channels, limits)
        return {"low": limits[0], "high": limits[1], "sensor": sensor}, {"image": image}


def _never_disconnected() -> bool:
    return False


def _read_limits(text: str) -> tuple[float, float]:
    """Parse the limits of a color scale, ``lowest,highest``.

    Raises ValueError if the limits are not finite or not in ascending order.
    """
    lower, upper = map(float, text.split(","))
    if not -math.inf < lower < upper < math.inf:
        raise ValueError(f"{text!r} is not a valid color range; expected LOWEST,HIGHEST")
    return lower, upper


def _add_counts(counts: Counter[int], values: AnyArray) -> None:
    labels, numbers = np.unique(values, return_counts=True)
    counts.update(dict(zip(labels.astype(np.int64).tolist(), numbers.tolist(), strict=True)))


def _cloud_extent(points: Points) -> tuple[Floats, Floats, Floats]:
    """Return points' local origin, their box without outliers, and their outermost points.

    The origin (3,) is in world coordinates, and the box (2, 3) and the outermost points (k, 3) are
    local. A coordinate of the origin is 0 unless the points are more than 10 km from 0. In that
    case, it is rounded to whole meters.
    """
    sample = read_positions(points, PointFinder(points, np.zeros(3)).find_points(_SAMPLE)[0])
    if not len(sample):
        empty_box = np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]])
        return np.zeros(3), empty_box, box_corners(empty_box)
    lower, upper = np.percentile(sample, [0.5, 99.5], axis=0)
    margin = _MAX_BEYOND * (upper - lower)
    inside = sample[((sample >= lower - margin) & (sample <= upper + margin)).all(axis=1)]
    inside = inside if len(inside) else sample
    box = np.stack([inside.min(axis=0), inside.max(axis=0)])
    origin = np.where(np.abs(box[0]) > 10_000, np.round(box[0]), 0.0)
    local = inside - origin
    outermost = [int((local @ direction).argmax()) for direction in golden_spiral(_CORNERS, -1.0)]
    return origin, box - origin, local[np.unique(outermost)]


class ProgressiveView:
    """A view of sampled points that is replaced once all points have been read.

    Parameters
    ----------
    sample
        View of the sample.
    total
        Number of all points.
    read
        Function that returns the view of all points. It is called in a thread after the first
        request for points. It receives a function that displays the points read so far, with their
        fraction of all points.
    """

    def __init__(
        self, sample: View, total: int, read: Callable[[Callable[[Points, float], None]], View]
    ) -> None:
        self.total = total
        self.note = sample.note
        self._view = sample
        self._read = read
        self._complete = False
        self._share = 0.0  # fraction of the points that has been read
        self._error = ""
        self._reading: threading.Thread | None = None
        self._lock = threading.Lock()

    def answer(
        self, question: str, arguments: Arguments, is_disconnected: Callable[[], bool]
    ) -> Answer:
        """Answer a request of the page.

        Requests are the same as for `View.answer`. In addition, the request "growth" returns the
        fraction of the points that has been read.
        """
        if question == "growth":
            header = {"complete": self._complete, "error": self._error, "share": self._share}
            return header | {"version": self._view.version}, {}
        is_sample = not self._complete
        header, arrays = self._view.answer(question, arguments, is_disconnected)
        if question == "state" and is_sample:
            header |= {"growing": True, "points": self.total, "exports": []}
        if question == "points":
            self._start()
        return header, arrays

    def _start(self) -> None:
        with self._lock:
            if self._reading is None:
                self._reading = threading.Thread(target=self._grow, name="reading", daemon=True)
                self._reading.start()

    def _grow(self) -> None:
        """Read all points and replace the sample."""
        try:
            view = self._read(self._show)
        except LidarError as error:
            self._error = str(error)
            return
        view.version += self._view.version
        self._view = view
        self._complete = True

    def _show(self, points: Points, share: float) -> None:
        """Display the points that have been read so far.

        `share` is the fraction of all points that has been read.
        """
        self._share = share
        self._view.replace_points(points, keep_scales=True)
