"""What a page shows of a survey: its answers to the page's questions; the command `view`."""

from __future__ import annotations

import math
import shutil
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import Any

import click
import numpy as np

from lidarsim.base.arrays import AnyArray, Bytes, Floats, Floats32, Ints
from lidarsim.base.errors import LidarError
from lidarsim.base.notebook import cell_display
from lidarsim.base.words import plural
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.columns.ply_format import AXES
from lidarsim.columns.table import AXES as POSITION
from lidarsim.columns.table import CAUSES, NO_SURFACE, OBJECT, TABLE, Column, X, Y, Z, value_names
from lidarsim.scene.actors import Actor, distinct_meshes, samples_per_actor
from lidarsim.scene.colours import as_bytes
from lidarsim.scene.scene import Scene
from lidarsim.scene.simplified import simplified
from lidarsim.sensor.trajectory import presence_ns
from lidarsim.sweeps.sweeps import SWEEPS_FILE, Sweeps
from raybeam import RayCaster

from ..picture_file import (
    MAX_POSITIONS,
    PICTURE_FILE,
    PictureContent,
    SensorPositions,
    moving_positions,
)
from ..render.closeup import floor_and_cut, surrounding_box
from ..render.colouring import (
    MAX_UNNAMED_LABELS,
    TURBO,
    Colouring,
    colours_of,
    values_of,
    with_rgb,
    word_of,
)
from ..render.hit_density import HITS_TITLE, hit_colours
from ..render.surface import separate_objects
from ..render.theme import mapped, object_colours
from .point_selection import (
    RESULT,
    Eye,
    Filter,
    HeldPoints,
    JoinedPoints,
    PointFinder,
    Points,
    ScanRanges,
    corners_of,
    positions,
    read_scans,
)
from .server import PORT, Answer, Arguments, PageServer, announced, page_server

MAX_POINTS = 20_000_000  # in an answer, and in a download
MAX_RAYS = 150  # more rays would hide the surfaces
_SAMPLE = 100_000  # points from which colour scales and limits are computed
_MAX_COLOURINGS = 64  # colour scales that are kept, of columns and filters
_HITS_SAMPLE = 500_000  # points whose density is shown on large triangles
_MAX_NAMES = 2000  # in a menu
# maximum of columns; rows for sensors with few or many channels
_IMAGE_WIDTH = 1024
_IMAGE_ROWS = 128
_COLUMN_SHARE = 0.9  # columns of a range image, as a share of a sensor's steps of azimuth
_MIN_CHANNELS = 4
_MAX_CHANNELS = 512
_MAX_DOWNWARD_SINE = -0.7  # sine of the median elevation of a sensor that looks down
_MAX_FIELD_RAD = math.radians(300)  # a spinning sensor sees more
_NS = 1e9
IN_SENSOR_AXES = "Points are in the axes of their sensor, where the scene does not fit."
MAX_TRIANGLES = 300_000  # 50 bytes each, sent again when colours change
MAX_PIECES = 60_000  # of large triangles, where hits are shown
_INWARD_SHARE = 1e-4  # of the scene's diagonal
_MAX_SIZE_M = 200.0  # of a scene: a shift of 2 cm is enough for any scene
MAX_LABELS = 1000  # in a legend
Legend = dict[str, Any]  # for the JSON of the page
CLOUD = "cloud.ply"


@dataclass(frozen=True)
class Downloads:
    """Formats in which a page offers points as files, and the function that writes a file."""

    formats: Sequence[str]  # suffixes of files without a dot, such as "las"
    save: Callable[[Cloud, Path], object]  # writes points in the format of the path's ending


@dataclass(eq=False)
class View:
    """A survey on a page, or a cloud alone.

    The scene is left out of a result whose points are in the axes of their sensors.
    """

    points: Points
    pictured: PictureContent | None = None
    sweeps: Sweeps | None = None
    note: str = ""  # a remark for the user
    title: str = "lidarpool"
    results: Sequence[str] = ()  # names, if the points are of several results
    # Returns the hits of each triangle, of actors' triangles last; by default as pictured.
    hits: Callable[[], AnyArray] | None = None
    triangles: int = MAX_TRIANGLES  # of the scene, that are shown
    downloads: Downloads | None = None  # None if points are not offered as files

    def __post_init__(self) -> None:
        self.version = 0  # of the points
        self.rays: Floats32 = np.zeros((0, 2, 3), np.float32)
        self.path: Floats | None = None
        sources = (source for source in (self.pictured, self.sweeps) if source is not None)
        if any(source.coordinates != "world" for source in sources):
            self.note = self.note or IN_SENSOR_AXES
        if self.sweeps is not None and self.sweeps.coordinates != "world":
            self.pictured = None
        if (pictured := self.pictured) is not None:
            self.rays = pictured.sample_rays
            if pictured.planning is not None and pictured.planning.best is not None:
                self.path = pictured.planning.best.corners
        self.origin, self._bounds, self._corners = self._extent()
        other_columns = {
            column.name: column for column in self.points.table if column not in POSITION
        }
        self.columns = {"z": Z, "x": X, "y": Y, **other_columns}  # to colour and filter by
        self._coloured = with_rgb(self.columns)
        self._lock = threading.Lock()
        self._surface: ShownSurface | None = None
        self._range_limits: dict[int, tuple[float, float]] = {}  # {sensor: ends of the scale}
        self.show(self.points)

    def show(self, points: Points) -> None:
        """Replace the points."""
        self.points = points
        self._finder = PointFinder(points, self.origin)
        self._colourings: dict[tuple[str, Filter], Colouring] = {}
        self.version += 1

    # -- properties of the survey ---------------------------------------------------------

    @cached_property
    def sensors(self) -> Sequence[SensorPositions]:
        """Positions of the sensors: exact, or at the starts of their sweeps."""
        if self.pictured is not None:
            return self.pictured.sensors
        sweeps = self.sweeps
        if sweeps is None:
            return ()
        sensors: list[SensorPositions] = []
        for number, name in enumerate(sweeps.sensors):
            of_sensor = sweeps.sensor == number
            local = sweeps.pose.positions[of_sensor] - self.origin
            if sweeps.coordinates != "world":  # each point is in the frame of its sensor
                local = np.zeros_like(local)
            moves = len(np.unique(local, axis=0)) > len(local) / 2 > 1
            sensors.append(SensorPositions(sweeps.begins_ns[of_sensor], local, moves, name))
        return sensors

    @property
    def actors(self) -> Sequence[Actor]:
        """Actors of the scene."""
        return () if self.pictured is None else self.pictured.scene.actors

    @property
    def duration_ns(self) -> float:
        """Duration of the survey in nanoseconds; 0 if unknown."""
        if self.pictured is not None and self.pictured.duration_ns:
            return self.pictured.duration_ns
        if self.sweeps is None or not len(self.sweeps):
            return 0.0
        starts = np.unique(self.sweeps.begins_ns)
        return float(starts[-1] + (np.diff(starts).min() if len(starts) > 1 else 0))

    def _names(self, column: str) -> Sequence[str]:
        """Names of the values 0, 1, 2, … of a column, if any."""
        if column == RESULT.name and self.results:
            return self.results
        if self.pictured is not None and column in self.columns:
            return self.pictured.names_of(self.columns[column])
        if (sweeps := self.sweeps) is not None:
            names: dict[str, Sequence[str]] = {
                "sensor": sweeps.sensors,
                "object": (*sweeps.objects, *sweeps.actors),
                "class": value_names(sweeps.classes),
                "material": sweeps.materials,
            }
            if column in names:
                return names[column]
        return CAUSES if self.columns.get(column) == TABLE["cause"] else ()

    def _extent(self) -> tuple[Floats, Floats, Floats]:
        """Return the local origin, the box (2, 3) of the view, and points (k, 3) to be in sight.

        These points are corners of the scene, sensors, and both ends of the planning. The corners
        of the box would be farther apart: around an object the box is mostly empty.
        """
        if self.pictured is None:
            origin, box = _cloud_extent(self.points)
            return origin, box, corners_of(box)
        scene = self.pictured.scene
        planning = self.pictured.planning
        sensors = [sensor.positions for sensor in self.pictured.sensors]
        corners = np.concatenate([corners_of(scene.bounds), *sensors])
        if planning is not None:
            level = corners[:, 2].min()
            corners = np.vstack([corners, [*planning.start, level], [*planning.target, level]])
        return scene.origin, np.stack([corners.min(axis=0), corners.max(axis=0)]), corners

    # -- answers -------------------------------------------------------------------------

    def answer(self, question: str, arguments: Arguments, abandoned: Callable[[], bool]) -> Answer:
        """Answer a question of the page."""
        answers: Mapping[str, Callable[[Arguments, Callable[[], bool]], Answer]] = {
            "state": lambda *_: self._state(),
            "points": self._points,
            "point": lambda arguments, _: self._point(int(arguments["row"])),
            "column": lambda arguments, _: self._column(arguments["name"]),
            "surface": lambda arguments, _: self._scene(arguments["colour"]),
            "range": lambda arguments, _: self._range(int(arguments["sweep"])),
            "export": self._export,
        }
        return answers[question](arguments, abandoned)

    def _state(self) -> Answer:
        """Return the state of the view, without points and surfaces."""
        shown_box = surrounding_box(
            self._bounds, moving_positions(self.sensors, self.actors, self.duration_ns)
        )
        box = self._bounds if shown_box is None else shown_box
        corners = self._corners if shown_box is None else corners_of(shown_box)
        arrays: dict[str, AnyArray] = {"rays": self.rays_shown, "corners": corners}
        for number, sensor in enumerate(self.sensors):
            arrays[f"sensor{number}_times"] = sensor.times_ns / _NS
            arrays[f"sensor{number}_places"] = sensor.positions
        arrays |= self._actor_arrays()
        if self.sweeps is not None:
            arrays["sweep_scans"] = self.sweeps.scans.astype(np.float64)
            arrays["sweep_begins"] = self.sweeps.begins_ns / _NS
            arrays["sweep_sensor"] = self.sweeps.sensor
        pictured = self.pictured
        objects = len(self._names("object"))
        statics = objects - len(self.actors)
        classes = self._classes_of_objects()
        result_numbers = np.arange(len(self.results))
        header = {
            "title": self.title,
            "version": self.version,
            "points": len(self.points),
            "columns": [
                {"name": name, "unit": "s" if column.unit == "ns" else column.unit,
                 "meaning": column.meaning} for name, column in self.columns.items()
            ],
            "colours": [*self._coloured],
            "origin": self.origin.tolist(),
            "box": box.tolist(),
            "bounds": self._bounds.tolist(),
            "cut": None if shown_box is None else float(shown_box[1, 2]),
            "scene": pictured and colours_for(pictured.scene, pictured.reflectance),
            "sensors": [
                {"name": sensor.name, "model": sensor.model, "moves": sensor.moves}
                for sensor in self.sensors
            ],
            "actors": [
                {"name": actor.name, "class": classes.get(number)}
                for number, actor in enumerate(self.actors, statics)
            ],
            "classes": {str(k): name for k, name in enumerate(self._names("class")) if name},
            "results": legend_of(colours_of(result_numbers, RESULT, self.results))["labels"],
            "exports": self._export_formats,
            "actor_colours": as_bytes(object_colours(objects))[statics:].tolist(),
            "statics": statics,
            "duration": self.duration_ns / _NS,
            "path": self.planned,
            "note": self.note,
        }  # fmt: skip
        return header, arrays

    def _actor_arrays(self) -> dict[str, AnyArray]:
        """Return meshes, with their poses if animated, and the trajectories of actors."""
        meshes, shapes = distinct_meshes(self.actors)
        arrays: dict[str, AnyArray] = {"actor_mesh": shapes.astype(np.int32)}  # no int64 in pages
        for k, mesh in enumerate(meshes):
            arrays[f"mesh{k}_corners"] = mesh.vertices[mesh.faces].astype(np.float32)
            if mesh.colours is not None:  # at the corners
                arrays[f"mesh{k}_colours"] = mesh.colours.means().repeat(3, axis=0)
            if mesh.animation is not None:
                arrays[f"mesh{k}_poses"] = mesh.animation.vertices.astype(np.float32)
                arrays[f"mesh{k}_faces"] = mesh.faces.astype(np.int32)
        sample_count = samples_per_actor(self.actors, MAX_POSITIONS)
        for k, actor in enumerate(self.actors):
            times, positions, rotations = actor.samples(self.duration_ns, sample_count)
            arrays |= {f"actor{k}_times": times / _NS, f"actor{k}_places": positions}
            arrays[f"actor{k}_turns"] = rotations
            arrays[f"actor{k}_there"] = np.array(presence_ns(actor.trajectory)) / _NS
            animation = actor.mesh.animation
            if animation is not None:  # after the last pose, pages start again
                frames = actor.seconds(times)[0] / animation.step_s
                last = len(animation.vertices) - 1 - 1e-6
                arrays[f"actor{k}_frames"] = frames if animation.repeat else frames.clip(0, last)
        return arrays

    @property
    def rays_shown(self) -> Floats32:
        """Rays (n, 2, 3), at most about `MAX_RAYS`."""
        return self.rays[:: len(self.rays) // MAX_RAYS + 1]

    @property
    def planned(self) -> dict[str, Any] | None:
        """Planned path and its obstacles; None without a path."""
        planning = None if self.pictured is None else self.pictured.planning
        if self.path is None or planning is None:
            return None
        discs = np.column_stack([planning.centres, planning.radii])
        return {"corners": self.path.tolist(), "discs": discs.tolist()}

    def _classes_of_objects(self) -> dict[int, int]:
        """Return {object: class}, from a sample of the points."""
        if not {"object", "class"} <= self.columns.keys():
            return {}
        rows, _ = self._finder.find(_SAMPLE)
        columns = (self.points.values(name, rows).tolist() for name in ("object", "class"))
        return dict(zip(*columns, strict=True))

    def _export(self, arguments: Arguments, abandoned: Callable[[], bool]) -> Answer:
        """Write the points for a filter and ranges of scans to a file; several files to a ZIP."""
        ending = arguments["format"]
        if self.downloads is None or ending not in self._export_formats:
            raise KeyError(ending)
        points = self.points
        sweeps = self.sweeps
        rows, count = self._finder.find(
            MAX_POINTS, *self._read_selection(arguments), None, abandoned
        )
        if count > MAX_POINTS:
            words = f"{count:,} points are more than {MAX_POINTS:,}: filter or clip them, or use"
            return {"error": f"{words} lidarpool export for all."}, {}
        columns = {column.name: points.values(column.name, rows) for column in points.table}
        world = np.stack([points.values(axis, rows) for axis in AXES], axis=1)
        further = tuple(column for column in points.table if column.name not in TABLE)
        cloud = Cloud(world, columns, further, None if sweeps is None else lambda: sweeps)
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
        """Formats of a download; none for a sample of a run under way."""
        if self.downloads is None or isinstance(self.points, HeldPoints):
            return ()
        return self.downloads.formats

    def _read_selection(self, arguments: Arguments) -> tuple[Filter, ScanRanges | None]:
        """Read the filter and the ranges of scans, ``first-last,first-last``, of a question."""
        point_filter = Filter.read(arguments.get("filter", ""), list(self.columns))
        return point_filter, read_scans(arguments["scans"]) if "scans" in arguments else None

    def _points(self, arguments: Arguments, abandoned: Callable[[], bool]) -> Answer:
        """Return points for a filter, ranges of scans and a camera, with their colours."""
        finder = self._finder
        version = self.version
        selection = self._read_selection(arguments)
        name = arguments["colour"]
        column = self._coloured[name]
        eye = Eye.read(arguments["eye"]) if "eye" in arguments else None
        max_points = max(1, min(int(arguments["most"]), MAX_POINTS))
        rows, count = finder.find(max_points, *selection, eye, abandoned)
        colouring = self._colouring(finder, name, selection[0], abandoned)
        values = values_of(column, lambda column_name: finder.points.values(column_name, rows))
        colours = np.full((len(rows), 4), 255, np.uint8)
        colours[:, :3] = as_bytes(colouring.paint(values))
        arrays: dict[str, AnyArray] = {
            "positions": (positions(finder.points, rows) - self.origin).astype(np.float32),
            "colours": colours,
            "rows": rows.astype(np.uint32),
        }
        legend: Legend | None = None
        if len(finder.points):
            legend = legend_of(colouring) | {"column": name, "meaning": column.meaning}
        return {"version": version, "count": count, "legend": legend}, arrays

    def _colouring(
        self, finder: PointFinder, name: str, point_filter: Filter, abandoned: Callable[[], bool]
    ) -> Colouring:
        """Return the colour scale of all points that a filter keeps, of any scan."""
        colourings = self._colourings
        colouring = colourings.get((name, point_filter))
        if colouring is None:
            rows, _ = finder.find(_SAMPLE, point_filter, None, None, abandoned)
            column = self._coloured[name]
            values = values_of(column, lambda column_name: finder.points.values(column_name, rows))
            colouring = colours_of(values, column, self._names(name))
            with self._lock:
                while len(colourings) >= _MAX_COLOURINGS:
                    del colourings[next(iter(colourings))]  # the oldest
                colourings[name, point_filter] = colouring
        return colouring

    def _column(self, name: str) -> Answer:
        """Return the limits of a column, or its labels, for filters."""
        column = self.columns[name]
        values = self._finder.points.values(name, self._finder.find(_SAMPLE)[0])
        values = values[np.isfinite(values)]
        names = self._names(name)
        distinct = np.unique(values)
        is_short = len(distinct) <= (_MAX_NAMES if names else MAX_UNNAMED_LABELS) and name != "scan"
        if column.kind == "label" and len(distinct) and is_short:
            labels = [
                [word_of(value, column, names), value]
                for value in distinct.astype(np.int64).tolist()
            ]
            return {"labels": labels}, {}
        unit = _NS if column.unit == "ns" else 1.0
        lower, upper = (float(distinct[0]), float(distinct[-1])) if len(distinct) else (0.0, 1.0)
        is_integer = values.dtype.kind in "iu" and unit == 1.0
        return {"low": lower / unit, "high": upper / unit, "unit": unit, "whole": is_integer}, {}

    def _point(self, row: int) -> Answer:
        """Return the position of a point, world coordinates, and all its columns in words."""
        points = self.points
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
        """Return a value of a column in words, with its unit."""
        names = self._names(column.name)
        if column == OBJECT and value < 0:
            return NO_SURFACE
        if column.kind == "label" and 0 <= value < len(names):
            return names[int(value)] or str(value)
        if column.unit == "ns":
            return f"{int(value) / 1e9:.9f} s"
        number = f"{value:.6g}" if np.issubdtype(type(value), np.floating) else f"{value}"
        return f"{number} {column.unit}".rstrip()

    def _scene(self, colour: str) -> Answer:
        """Return triangles of the scene in their colours, and the heights of floor and cut."""
        pictured = self.pictured
        if pictured is None:
            raise KeyError("surface")
        with self._lock:  # browsers wait for the first, which may take long
            surface = self._surface = self._surface or ShownSurface(
                pictured.scene, pictured.reflectance, self.triangles
            )
        counts = pictured.hit_counts
        hit_points = np.zeros((0, 3), np.float32)
        if colour == "hits":
            counts = counts if self.hits is None else self.hits()
            counts = counts[: len(pictured.scene.faces)]
            rows, _ = self._finder.find(_HITS_SAMPLE)
            if "object" in self.columns:  # points on static objects only
                owners = self._finder.points.values("object", rows)
                rows = rows[(owners >= 0) & (owners < len(pictured.scene.names))]
            hit_points = (positions(self._finder.points, rows) - self.origin).astype(np.float32)
        arrays, legend = surface.coloured(colour, counts, hit_points)
        return {"legend": legend} | self._look_around, arrays

    @cached_property
    def _look_around(self) -> dict[str, float | None]:
        """Height of the floor, and of the cut that opens a building around the sensors."""
        surface = self._surface
        pictured = self.pictured
        poses = [sensor.positions for sensor in self.sensors if len(sensor.positions)]
        if surface is None or pictured is None or not poses:
            return {"floor": None, "roof_cut": None}
        scene = surface.coarse
        caster = RayCaster(scene.vertices, scene.faces)
        floor, cut = floor_and_cut(scene, caster, np.concatenate(poses))
        return {"floor": floor, "roof_cut": cut}

    def _range(self, sweep: int) -> Answer:
        """Return the range image of a sweep, rows from above, columns from left to right."""
        sweeps = self.sweeps
        finder = self._finder
        if sweeps is None or not 0 <= sweep < len(sweeps):
            raise KeyError(sweep)
        first, last = (int(scan) for scan in sweeps.scans[sweep : sweep + 2])
        rows, _ = finder.find(MAX_POINTS, scans=((first, last - 1),))
        image = np.zeros((1, 1, 4), np.uint8)
        limits = (0.0, 1.0)
        number = int(sweeps.sensor[sweep])
        if len(rows):
            local = sweeps.in_sensor(sweep, positions(finder.points, rows))
            channels = None
            if "channel" in self.columns:
                channels = finder.points.values("channel", rows).astype(np.int64)
            ranges = np.linalg.norm(local, axis=1)
            if number not in self._range_limits:  # one scale for all sweeps of a sensor
                lower, upper = np.percentile(ranges, [1, 99])
                self._range_limits[number] = float(lower), float(upper)
            limits = self._range_limits[number]
            image = range_image(local, ranges, channels, limits)
        return {"low": limits[0], "high": limits[1], "sensor": number}, {"image": image}


def range_image(
    points: Floats, ranges: Floats, channels: Ints | None, limits: tuple[float, float]
) -> Bytes:
    """Return a range image of points in the sensor frame, RGBA (rows, columns, 4).

    Of several points in a pixel the nearest is shown. Rows are channels, the highest above, or
    steps of elevation if the sensor has few or very many channels. Columns are steps of azimuth
    from left to right. A sensor that looks down has a single row, of angles across its trajectory.
    Empty pixels are transparent.
    """
    downwards = float(np.median(points[:, 2] / np.maximum(ranges, 1e-9))) < _MAX_DOWNWARD_SINE
    azimuth = np.arctan2(points[:, 1], -points[:, 2] if downwards else points[:, 0])
    azimuth_left = float(azimuth.max())
    azimuth_right = float(azimuth.min())
    if azimuth_left - azimuth_right > _MAX_FIELD_RAD:
        azimuth_left = math.pi
        azimuth_right = -math.pi
    field = azimuth_left - azimuth_right
    if downwards:
        row_count = 1
        row = np.zeros(len(points), np.int64)
    else:
        row, row_count = _image_rows(points, ranges, channels)
    fullest = azimuth[row == np.bincount(row).argmax()]
    spacing = float(np.ptp(fullest)) / len(fullest)  # between two points; columns are wider
    width = int(np.clip(_COLUMN_SHARE * field / max(spacing, 1e-9), 32, _IMAGE_WIDTH))
    column = ((azimuth_left - azimuth) * (width / max(field, 1e-9))).astype(np.int64)
    image = np.zeros((row_count, width, 4), np.uint8)
    order = np.argsort(-ranges, kind="stable")  # the nearest is written last
    image[row[order], np.minimum(column, width - 1)[order]] = _range_colours(ranges, limits)[order]
    return image


def _image_rows(points: Floats, ranges: Floats, channels: Ints | None) -> tuple[Ints, int]:
    """Return the rows (n,) of points in a range image, and the number of rows."""
    if channels is not None:
        count = int(channels.max()) + 1
        if _MIN_CHANNELS <= count <= _MAX_CHANNELS:
            return count - 1 - channels, count
    elevation = np.arcsin(points[:, 2] / np.maximum(ranges, 1e-9))
    span = float(np.ptp(elevation)) or 1.0
    row = ((elevation.max() - elevation) * ((_IMAGE_ROWS - 1) / span)).astype(np.int64)
    return row, _IMAGE_ROWS


def _range_colours(ranges: Floats, limits: tuple[float, float]) -> Bytes:
    """Return the colours (n, 4) of ranges (n,) between limits."""
    lower, upper = limits
    shade = np.clip((ranges - lower) / max(upper - lower, 1e-9), 0, 1)
    colours = np.full((len(ranges), 4), 255, np.uint8)
    colours[:, :3] = as_bytes(mapped("viridis_r", shade))
    return colours


def _cloud_extent(points: Points) -> tuple[Floats, Floats]:
    """Return an origin in whole metres close to the points, and their box without outliers."""
    sample = positions(points, PointFinder(points, np.zeros(3)).find(_SAMPLE)[0])
    if not len(sample):
        return np.zeros(3), np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]])
    box = np.percentile(sample, [0.5, 99.5], axis=0)
    origin = np.where(np.abs(box[0]) > 10_000, np.round(box[0]), 0.0)
    return origin, box - origin


class ShownSurface:
    """A scene's triangles in chosen colours, simplified to a maximum number.

    Vertices in the same cell of a grid are merged (Rossignac and Borrel, 1993), and hits of a
    triangle that vanishes go to a neighbour. `reflectance` is the share of the light that each
    object reflects, (objects,), if known.
    """

    def __init__(
        self, scene: Scene, reflectance: Floats | None = None, max_triangles: int = MAX_TRIANGLES
    ) -> None:
        self.coarse = scene
        self._reflectance = reflectance
        # (f,): shown triangle that replaces each triangle of the scene; -1 if none does.
        self._replacements = np.arange(len(scene.faces))
        if len(scene.faces) > max_triangles:
            self.coarse, self._replacements = simplified(scene, max_triangles)
        self._objects = self.coarse.face_object.astype(np.int32)  # as browsers have them
        size = float(np.linalg.norm(np.ptp(scene.bounds, axis=0)))
        moved = separate_objects(self.coarse, self._objects, _INWARD_SHARE * min(size, _MAX_SIZE_M))
        self.corners = moved.vertices[moved.faces].astype(np.float32)  # (f, 3, 3)

    def coloured(
        self, by: str, hit_counts: AnyArray, points: Floats32
    ) -> tuple[dict[str, AnyArray], Legend | None]:
        """Return corners (k, 3, 3), objects (k,), colours (k, 3, 3) at the corners; and a legend.

        `by` is a name of `colours_for` the scene; "hits" needs the hits (f,) of its triangles, and
        a sample of the hit points, (n, 3). There are no colours for "grey", which the page defines.
        """
        arrays: dict[str, AnyArray] = {"corners": self.corners, "objects": self._objects}
        legend: Legend | None = None
        if by == "hits":
            return self._coloured_by_hits(hit_counts, points)
        if by == "object":
            colouring = colours_of(self._objects, OBJECT, self.coarse.names)
            colours = colouring.paint(self._objects)
            legend = legend_of(colouring)
        elif by == "reflectance" and self._reflectance is not None:
            colours = mapped("gray", 0.1 + 0.9 * self._reflectance[self._objects])
            greys = mapped("gray", np.linspace(0.1, 1.0, 9))
            legend = scale_legend("reflectance", ("0", "0.5", "1"), greys)
        elif by == "colour" and self.coarse.colours is not None:
            colours = self.coarse.colours.means() / 255
        else:
            return arrays, None
        corners = as_bytes(colours).repeat(3, axis=0).reshape(-1, 3, 3)
        return arrays | {"colours": corners}, legend

    def _coloured_by_hits(
        self, hit_counts: AnyArray, points: Floats32
    ) -> tuple[dict[str, AnyArray], Legend | None]:
        """Return the arrays and the legend of `coloured` by hits (f,) of the scene's triangles."""
        is_shown = self._replacements >= 0
        hits = np.bincount(self._replacements[is_shown], hit_counts[is_shown], len(self.corners))
        max_pieces = len(self.corners) + MAX_PIECES
        corners, owner, colours, (lower, upper) = hit_colours(
            self.coarse, self.corners, hits.astype(float), points, max_pieces
        )
        arrays: dict[str, AnyArray] = {
            "corners": corners,
            "objects": self._objects[owner],
            "colours": as_bytes(colours),
        }
        densities = (lower, (lower * upper) ** 0.5, upper)
        marks = [f"{n:.2g}" if n < 10 else f"{n:,.0f}" for n in densities]
        return arrays, scale_legend(HITS_TITLE, marks) if hits.any() else None


def colours_for(scene: Scene, reflectance: Floats | None) -> tuple[str, ...]:
    """List the colourings of a scene, with reflectance and its own colours if there are any."""
    scene_colours = ("colour",) if scene.coloured else ()
    reflectances = (
        ("reflectance",) if reflectance is not None and len(np.unique(reflectance)) > 1 else ()
    )
    return ("grey", "hits", "object", *reflectances, *scene_colours)


def legend_of(colouring: Colouring) -> Legend:
    """Return the legend of colours: a scale with numbers, or labels with their values."""
    if colouring.limits is None:
        labels = [
            [name, as_bytes(colour).tolist(), value]
            for (name, colour), value in zip(colouring.labels, colouring.values, strict=True)
        ]
        hidden = len(labels) - MAX_LABELS
        return {"labels": labels[:MAX_LABELS], "more": max(hidden, 0), "column": colouring.name}
    lower, upper = colouring.limits
    title = f"{colouring.name}, {colouring.unit}" if colouring.unit else colouring.name
    title += f": {colouring.meaning}" if colouring.meaning else ""
    if colouring.logarithmic:
        marks = [f"{number:.2g}" for number in (lower, (lower * upper) ** 0.5, upper)]
    else:  # as many digits as a bar of this span needs, and never -0
        digits = int(np.clip(np.ceil(1 - np.log10(upper - lower)), 0, 6)) if upper > lower else 2
        marks = [
            f"{round(number, digits) + 0.0:,.{digits}f}"
            for number in (lower, (lower + upper) / 2, upper)
        ]
    return scale_legend(title, marks, colouring.scale[::15])


def scale_legend(title: str, marks: Sequence[str], colours: Floats = TURBO[::15]) -> Legend:
    """Return the legend of a scale of colours (n, 3), with evenly spread marks."""
    return {"title": title, "marks": list(marks), "colours": as_bytes(colours).tolist()}


@contextmanager
def result_page(view: View, *, port: int = PORT, browser: bool = True) -> Iterator[PageServer]:
    """Serve the page of a result while the body runs, and announce its address."""
    shows = f"shows {plural(len(view.points), 'point')}"
    shows += "" if cell_display() else "; Ctrl-C ends it"
    with (
        page_server(view.answer, port) as page,
        announced(page, f"{page.url} {shows}", browser, on_stdout=True),
    ):
        yield page


def wait_for_interrupt(stopped: Event | None = None) -> None:
    """Keep a page open until Ctrl-C, or until its user stops the page."""
    stopped = stopped or Event()
    with suppress(KeyboardInterrupt):
        while not stopped.wait(0.2):  # Ctrl-C does not end an unlimited wait everywhere
            pass


def show_view(view: View, *, port: int, browser: bool = True) -> None:
    """Show a view in the browser until Ctrl-C."""
    if view.note:
        click.echo(f"note: {view.note}", err=True)
    with result_page(view, port=port, browser=browser):
        wait_for_interrupt()


def open_results(paths: Sequence[Path], downloads: Downloads | None = None) -> View:
    """Open results of a place as a view, with the scene, sensors and actors of the first result.

    The view can be played if the sweeps of all results start at the same times. LidarError if a
    result has no cloud, a damaged cloud, or points in the frames of the sensors.
    """
    first, *further = views = [open_result(path, downloads) for path in paths]
    if not further:
        return first
    if IN_SENSOR_AXES in (notes := [view.note for view in views]):
        raise LidarError(
            f"{paths[notes.index(IN_SENSOR_AXES)]} has points in the axes of its sensors, which "
            "fit no other result: show it alone, or run it with cloud.coordinates: world."
        )
    names = [path.resolve().name for path in paths]
    names = names if len({*names}) == len(names) else [str(path) for path in paths]
    starts = [() if view.sweeps is None else view.sweeps.begins_ns for view in views]
    sweeps = first.sweeps if all(np.array_equal(starts[0], times) for times in starts) else None
    points = JoinedPoints([view.points for view in views])
    title = f"{' and '.join(names)} - lidarpool"
    return View(
        points,
        first.pictured,
        sweeps,
        " ".join(notes).strip(),
        title,
        results=names,
        downloads=downloads,
    )


def open_result(path: Path, downloads: Downloads | None = None) -> View:
    """Open a cloud or the folder of a result, with its scene and sweeps if they are in the folder.

    A scene or sweeps that cannot be read are noted only. LidarError if there is no cloud, or a
    damaged cloud.
    """
    title = f"{path.resolve().name} - lidarpool"
    if not path.is_dir():
        return View(CloudFile(path), title=title, downloads=downloads)
    cloud = path / CLOUD
    if not cloud.exists():
        raise LidarError(
            f"{path} holds no {CLOUD}: give the folder of a result (its --out), or a cloud."
        )
    scene_file = path / PICTURE_FILE
    sweeps_file = path / SWEEPS_FILE
    pictured = None
    sweeps = None
    note = ""
    try:
        sweeps = Sweeps.load(sweeps_file) if sweeps_file.exists() else None
        pictured = PictureContent.load(scene_file) if scene_file.exists() else None
    except LidarError as error:
        note = f"The cloud is shown without all that belongs to it. {error}"
    file = CloudFile(cloud, pictured.extra_columns if pictured else ())
    return View(file, pictured, sweeps, note, title, downloads=downloads)
