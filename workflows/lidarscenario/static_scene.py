"""Static scene of a scenario.

The static scene consists of mesh files, copies of objects, the ground and the objects of the demo.
It can be cached and shared between scenarios.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from lidarscenes.files.formats import ROBOTS
from lidarscenes.robots.robot import Robot
from lidarscenes.robots.urdf import load_robot
from lidarsim.errors import LidarError, Mistakes, message_of, prefix_errors
from lidarsim.io.tables import NUMBERS, Quantity, read_table
from lidarsim.io.textfile import read_text
from lidarsim.motion.pose_columns import (
    ANGLES,
    POSITION,
    REFUSED_COLUMNS,
    convert_heading,
    stack_angles,
)
from lidarsim.motion.rotations import rotations_of
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.actors import Actor, box, join_meshes
from lidarsim.scene.files.mesh_formats import format_of, option_names
from lidarsim.scene.files.meshfile import Objects, load_objects
from lidarsim.scene.files.scene_graph import ObjectClass
from lidarsim.scene.object_names import resolve_same_names
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_instances import SceneInstance
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.scene.shapes import seed_objects
from lidarsim.scene.transform import Transform, affine
from lidarsim.scene.wheels import animate_wheels
from lidarsim.words import join_names, plural

from .scenario import Scenario
from .sections import (
    MAX_COPIES,
    CopiesSection,
    CopyTable,
    MeshFile,
    ResolvePath,
    Scatter,
    SceneSection,
    ShapeSection,
    file_states,
)
from .traffic.ground import SupportSurfaces

# Fields of a `MeshFile` that are allowed if the file is a robot.
_ROBOT_FIELDS = {"file", "opacity", "assets", "translation", "rotation_deg", "scale", "matrix"}


Value = TypeVar("Value")


class FileCrs(NamedTuple):
    """Coordinate system of a file whose x and y coordinates, or heights, are not transformed."""

    file: str
    crs: str  # as "EPSG:25832" or WKT; empty if it is unknown, or if x and y are transformed
    epsg: int | None
    is_raster: bool  # whether the file is reprojected to `world.epsg`
    # Datum of the heights, empty if it is unknown, or None if heights are transformed.
    vertical_datum: str | None


@dataclass
class FileFindings:
    """Notes and metadata collected from the files of a scene."""

    notes: list[str] = field(default_factory=list)  # notes for the user, such as skipped objects
    remarks: list[str] = field(default_factory=list)  # remarks on the up axes of files
    sources: dict[str, str] = field(default_factory=dict)  # {file: description of its content}
    systems: list[FileCrs] = field(default_factory=list)  # coordinate systems of the files
    landscapes: list[str] = field(default_factory=list)  # files that contain terrain or roads
    # {file: {class number: class}} for files whose format assigns classes to objects
    classes: dict[str, Mapping[int, ObjectClass]] = field(default_factory=dict)
    # {name of the platform or actor: whether its path has corners} for trajectories without angles
    without_angles: dict[str, bool] = field(default_factory=dict)

    def copy(self) -> FileFindings:
        """Return a copy with its own lists and dictionaries."""
        return FileFindings(*(values.copy() for values in vars(self).values()))

    def class_patterns(self, number: int) -> tuple[str, ...]:
        """Return patterns that match the objects to which files assign the class `number`."""
        patterns = dict.fromkeys(
            pattern
            for classes in self.classes.values()
            if number in classes
            for pattern in classes[number].patterns
        )
        return tuple(patterns)

    @property
    def class_names(self) -> dict[int, str]:
        """Names of the classes that files assign to objects, keyed by class number."""
        names = {
            number: entry.name
            for classes in self.classes.values()
            for number, entry in classes.items()
        }
        return dict(sorted(names.items()))


class StaticScene(NamedTuple):
    """Scene without actors and traffic, with the findings from its files."""

    scene: Scene
    support: SupportSurfaces
    findings: FileFindings


class _StaticObjects(NamedTuple):
    """Objects of a static scene, excluding the ground."""

    objects: Objects
    findings: FileFindings
    corners: Floats  # (n, 2), corners of the horizontal extent in world coordinates, in meters


class SceneCache:
    """Cache of the `max_scenes` most recently used static scenes.

    Scenarios share a scene if they have the same scene section, the same reading options and the
    same ground, and if their files have not changed.
    """

    def __init__(self, max_scenes: int = 4) -> None:
        self._objects = _LeastRecentlyUsedCache[_StaticObjects](max_scenes)
        self._scenes = _LeastRecentlyUsedCache[StaticScene](max_scenes)

    def get_scene(self, scenario: Scenario) -> StaticScene:
        """Return the static scene of a scenario, reading its files if it is not cached."""
        key = _cache_key(scenario)
        if scenario.scene.ground is None:
            return self._scenes.get_or_create(key, lambda: read_static_scene(scenario))
        static = self._objects.get_or_create(key, lambda: _read_objects(scenario))
        ground = _build_ground(scenario, static)
        rectangle = ground.vertices.tobytes()
        return self._scenes.get_or_create((key, rectangle), lambda: _static_scene(static, ground))


class _LeastRecentlyUsedCache(Generic[Value]):
    """Cache that discards the least recently used values."""

    def __init__(self, max_count: int) -> None:
        self._max_count = max_count
        self._values = dict[object, Value]()

    def get_or_create(self, key: object, make: Callable[[], Value]) -> Value:
        """Return the value for a key, creating it if it is not cached."""
        value = self._values.pop(key) if key in self._values else make()
        self._values[key] = value  # dictionaries are ordered, so the most recent value is the last
        while len(self._values) > self._max_count:
            del self._values[next(iter(self._values))]
        return value


def _cache_key(scenario: Scenario) -> object:
    """Return the key under which the static objects of a scenario are cached.

    Scenarios with equal keys can share their static objects. The key consists of the scene section,
    the reading options, and the sizes and modification times of the files.
    """
    section = scenario.scene
    files: list[str] = [entry.file for entry in section.files]
    for copies in section.copies:
        files += [entry.file for entry in (copies.file, copies.table) if entry is not None]
    states = file_states(map(scenario.path, files))
    reading_options = (
        scenario.path(""),
        scenario.needs_colors,
        scenario.needs_material_names,
        scenario.world.epsg,
    )
    return section.model_dump_json(), *reading_options, states


def read_static_scene(scenario: Scenario) -> StaticScene:
    """Read the mesh files of a scenario, and place its copies and ground.

    The scene contains the objects of the demo if the scenario uses them, followed by the objects in
    mesh files, the copies and the ground. The actors of the scene are the objects that move in
    their files.

    Raises
    ------
    LidarError
        If the scenario has no scene, if a file cannot be read, or if there is no surface or not
        enough space for the copies.
    """
    static = _read_objects(scenario)
    has_ground = scenario.scene.ground is not None
    return _static_scene(static, _build_ground(scenario, static) if has_ground else None)


def _static_scene(static: _StaticObjects, ground: SceneMesh | None) -> StaticScene:
    """Create a scene from static objects and an optional ground."""
    objects = static.objects
    findings = static.findings.copy()
    if ground is not None:
        objects = objects._replace(static=(*objects.static, ground))
    scene = Scene.from_objects(objects, findings.notes.append)
    return StaticScene(scene, SupportSurfaces(scene), findings)


def _read_objects(scenario: Scenario) -> _StaticObjects:
    """Read the mesh files of a scenario, and place its copies."""
    section = scenario.scene
    _check_not_empty(scenario)
    findings = FileFindings()
    shapes = ShapeLoader(scenario, findings)
    meshes: list[SceneMesh | SceneInstance] = list(seed_objects()) if section.has_seed else []
    moving: list[Actor] = []
    mistakes = Mistakes()
    for entry in section.files:
        with mistakes.collect():
            objects = shapes.read_objects(entry)
            meshes += objects.static
            moving += objects.actors
            if objects.classes:
                findings.classes[entry.file] = objects.classes
            if system := _file_crs(entry, objects):
                findings.systems.append(system)
    mistakes.raise_if_any()
    meshes = resolve_same_names(meshes, section.same_names, findings.notes.append)
    if section.copies:
        meshes += _place_copies(shapes, meshes)
    objects = Objects(tuple(meshes), tuple(moving))
    corners = np.zeros((0, 2))
    if section.ground is not None and (meshes or moving):
        corners = _horizontal_bounds(Scene.from_meshes(meshes or objects.at_start(lambda _: None)))
    return _StaticObjects(objects, findings, corners)


def _file_crs(entry: MeshFile, objects: Objects) -> FileCrs | None:
    """Return the coordinate system that a file states.

    Return None if the file specifies neither a coordinate system nor a vertical datum, or if both
    its coordinates and its heights are transformed.
    """
    transform = entry.transform()
    raster = objects.raster
    epsg = objects.epsg if raster is None else raster.epsg
    crs = raster.crs if raster is not None else f"EPSG:{epsg}" if epsg else ""
    if not (crs or objects.vertical_datum):
        return None
    is_raster = raster is not None
    datum = objects.vertical_datum if transform.keeps_z else None
    if not transform.keeps_xy:
        return FileCrs(entry.file, "", None, is_raster, datum) if datum else None
    return FileCrs(entry.file, crs, epsg, is_raster, datum)


def _check_not_empty(scenario: Scenario) -> None:
    """Raise LidarError if a scenario contains no static objects."""
    section = scenario.scene
    if section.has_seed or section.files or section.copies or section.ground is not None:
        return
    if scenario.actors or scenario.traffic is not None:
        raise LidarError(
            f"{scenario.source}: The scene has actors, but no stationary object. Add "
            "`scene: {ground: {}}`, or mesh files as `scene.files`."
        )
    raise LidarError(
        f"{scenario.source}: The scenario has no scene. Add mesh files as `scene.files`, or "
        "`scene: seed` for the six objects of `lidarpool demo`."
    )


class ShapeLoader:
    """Reader for the meshes and robots of a scenario.

    Shapes are cached, so that entries with the same shape share it. Notes are added to `findings`.
    """

    def __init__(self, scenario: Scenario, findings: FileFindings) -> None:
        self.scenario = scenario
        self.findings = findings
        self._meshes: dict[Any, SceneMesh] = {}  # {(file or box, animation, wheels): mesh}
        self._robots: dict[MeshFile, Robot] = {}

    def load_mesh(self, entry: ShapeSection) -> SceneMesh:
        """Return the mesh of a copy, actor or vehicle.

        The mesh is a box, or all objects in a file, which are merged. Entries with the same file,
        animation and wheels share a mesh, which has the name of the first of these entries. Objects
        that move in the file are at their first poses.
        """
        shape = entry.file or entry.box or (1.0, 1.0, 1.0)
        meshes = self._meshes
        animation, wheels = (getattr(entry, name, None) for name in ("animation", "wheels"))
        animation_key = animation and (animation.name, animation.speed_m_s, animation.repeat)
        key = shape, animation_key, wheels
        if key not in meshes:
            name = entry.name or "vehicle"
            if not isinstance(shape, MeshFile):
                return meshes.setdefault(key, box(name, shape))
            # An empty string selects the first animation in the file.
            file_objects = self.read_objects(shape, animation and (animation.name or ""))
            path = self.scenario.path(shape.file)
            objects = file_objects.at_start(
                lambda line: self.findings.notes.append(f"{path} moves {line}")
            )
            if wheels is not None:
                with prefix_errors(path):
                    objects = (*animate_wheels(objects, wheels, self.findings.notes.append),)
            mesh = meshes[key] = join_meshes(name, objects)
            if animation is not None and mesh.animation is not None:
                settings = {"speed_m_s": animation.speed_m_s, "repeat": animation.repeat}
                meshes[key] = replace(mesh, animation=replace(mesh.animation, **settings))
        return meshes[key]

    def load_robot(self, entry: MeshFile) -> Robot:
        """Return the robot that a file describes.

        Raise LidarError if the file cannot be used.
        """
        if entry not in self._robots:
            path = self.scenario.path(entry.file)
            report = self.findings.notes.append
            colors = self.scenario.needs_colors
            name_materials = self.scenario.needs_material_names
            robot = load_robot(
                path,
                opacity=entry.opacity,
                colors=colors,
                materials=name_materials,
                assets=self._assets_folder(entry),
                report=report,
            )
            self._robots[entry] = robot
            self.findings.sources[entry.file] = robot.summary
        return self._robots[entry]

    def _assets_folder(self, entry: MeshFile) -> Path | None:
        return None if entry.assets is None else self.scenario.path(entry.assets)

    def read_objects(self, entry: MeshFile, animation: str | None = None) -> Objects:
        """Read the objects of a file in world coordinates.

        `animation` is the name of the animation that the meshes play. An empty string selects the
        first animation in the file, and None selects no animation. Raise LidarError if the file
        cannot be used.
        """
        scenario = self.scenario
        findings = self.findings
        with prefix_errors(scenario.source):
            transform = entry.transform()
        if entry.file.lower().endswith(ROBOTS):
            return self._stationary_robot(entry, transform)
        path = scenario.path(entry.file)
        world_options = {}
        if "epsg" in option_names(format_of(path)):
            world_options["epsg"] = scenario.world.epsg
        objects = load_objects(
            path,
            **entry.reading_options,
            **world_options,
            transform=transform,
            colors=scenario.needs_colors,
            materials=scenario.needs_material_names,
            assets=self._assets_folder(entry),
            animation=animation,
            report=findings.notes.append,
            axes=findings.remarks.append,
        )
        findings.sources.setdefault(entry.file, objects.summary)
        if objects.is_landscape:
            findings.landscapes.append(entry.file)
        return objects

    def _stationary_robot(self, entry: MeshFile, transform: Transform) -> Objects:
        """Return the links of a robot as static objects, with all joint values at zero."""
        if refused_fields := sorted(entry.model_fields_set - _ROBOT_FIELDS):
            raise LidarError(
                f"{self.scenario.path(entry.file)} is a robot, which is always in meters with z "
                f"up. Remove {join_names([f'`{name}`' for name in refused_fields])}."
            )
        robot = self.load_robot(entry)
        report = self.findings.notes.append
        if robot.moving:
            report(
                f"all joints of {entry.file} are at zero. To move them, add the robot as an actor "
                "with `joints`"
            )
        links = Objects((), robot.actors(report=report)).at_start(lambda _: None)
        return Objects(
            tuple(o.affine_transform(o.name, transform.linear, transform.offset) for o in links)
        )


def _place_copies(
    shapes: ShapeLoader, static_objects: list[SceneMesh | SceneInstance]
) -> list[SceneInstance]:
    """Place the copies of a scenario on static objects and the ground, but not on other copies.

    `static_objects` are the objects of the demo and of mesh files, in world coordinates.
    """
    scenario = shapes.scenario
    section = shapes.scenario.scene
    scene = Scene.from_meshes(static_objects) if static_objects else None
    if section.ground is not None and (static_objects or _copy_extents(section)):
        corners = [] if scene is None else [_horizontal_bounds(scene)]
        ground = _build_ground_mesh(section, [*corners, *_copy_extents(section)])
        scene = Scene.from_meshes([*static_objects, ground])
    support = SupportSurfaces(scene)
    copies: list[SceneInstance] = []
    mistakes = Mistakes()
    for number, entry in enumerate(section.copies):
        with mistakes.collect():
            mesh = shapes.load_mesh(entry)
            with prefix_errors(f"{scenario.source}: scene.copies[{number}]"):
                instances = place_copies(entry, mesh, support, scenario.path)
            if entry.file is not None:
                words = f", {plural(len(instances), 'copy', 'copies')}"
                shapes.findings.sources[entry.file.file] += words
            copies += instances
    mistakes.raise_if_any()
    return copies


def _copy_extents(section: SceneSection) -> list[Floats]:
    """Return the given positions of copies, and the corners of rectangles for random copies.

    Each array has shape (n, 2) and contains world coordinates in meters.
    """
    scatters = [entry.scatter for entry in section.copies if entry.scatter is not None]
    position_lists = [[copy.position[:2] for copy in entry.at] for entry in section.copies]
    return [
        *(np.reshape(scatter.within, (2, 2)) for scatter in scatters if scatter.within is not None),
        *(np.array(positions, np.float64) for positions in position_lists if positions),
    ]


def _footprints(scenario: Scenario) -> list[Floats]:
    """Return the horizontal positions that a scenario's ground must cover.

    They are the rectangles and positions of copies, the poses of the sensor and of actors, and the
    trajectories of the platform and of actors. Vehicles in traffic are not included. Each array has
    shape (n, 2) and contains world coordinates in meters.
    """
    footprints = _copy_extents(scenario.scene)
    poses = [*(scenario.poses or ()), *(entry.at for entry in scenario.actors if entry.at)]
    footprints.append(np.reshape([pose.position[:2] for pose in poses], (-1, 2)))
    with prefix_errors(scenario.source):
        if scenario.trajectory is not None:
            footprints.append(scenario.trajectory.footprint(scenario.path))
        for entry in scenario.actors:
            if entry.trajectory is not None:
                with prefix_errors(f"actor {entry.name!r}"):
                    footprints.append(entry.trajectory.footprint(scenario.path))
    return footprints


def _horizontal_bounds(scene: Scene) -> Floats:
    """Return the horizontal bounds of a scene in world coordinates, in meters.

    The result has shape (2, 2).
    """
    return (scene.bounds + scene.origin)[:, :2]


def _build_ground(scenario: Scenario, static: _StaticObjects) -> SceneMesh:
    """Create the ground of a scenario.

    Raise LidarError if the scenario has nothing that determines the extent of the ground.
    """
    footprints = [static.corners, *_footprints(scenario)]
    if not any(map(len, footprints)):
        raise LidarError(
            f"{scenario.source}: The extent of `scene.ground` cannot be determined, because the "
            "scenario has no objects, poses, trajectories or actors. Add `poses`, or mesh files "
            "as `scene.files`."
        )
    return _build_ground_mesh(scenario.scene, footprints)


def _build_ground_mesh(section: SceneSection, footprints: Sequence[Floats]) -> SceneMesh:
    """Create the ground mesh in world coordinates.

    The ground consists of two triangles. It covers all points in `footprints` with a margin.
    """
    ground = section.ground
    assert ground is not None, "only called for sections with a ground"
    points = np.concatenate(footprints)
    x0, y0 = points.min(axis=0) - ground.margin_m
    x1, y1 = points.max(axis=0) + ground.margin_m
    z = ground.height_m
    corners = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]])
    return SceneMesh("Ground", corners, np.array([[0, 1, 2], [0, 2, 3]]))


MIN_SCALE = 1e-6
DRAW_SIZE = 1 << 14  # number of random positions that are drawn at a time
# The maximum number of positions that are drawn for an entry is the larger of these limits.
MAX_DRAWS_PER_COPY = 200
MAX_DRAWS = 1 << 21

_POSITION_NAMES = ("x", "y", "z")
_ANGLE_NAMES = ("yaw_deg", "pitch_deg", "roll_deg")
_SCALE_NAMES = ("scale_x", "scale_y", "scale_z")
_COPY_COLUMNS = (
    *POSITION,
    *ANGLES,
    *(Quantity(name, (name,), NUMBERS, "") for name in ("scale", *_SCALE_NAMES)),
)


def place_copies(
    entry: CopiesSection, mesh: SceneMesh, support: SupportSurfaces, path: ResolvePath
) -> list[SceneInstance]:
    """Place the copies that an entry describes.

    Parameters
    ----------
    entry
        Section that defines the copies.
    mesh
        Mesh that all copies share.
    support
        Surfaces on which copies without a height are placed.
    path
        Function that returns the path of a file in the scenario.

    Raises
    ------
    LidarError
        If a table cannot be read, if there is no surface at the position of a copy, or if there is
        not enough space for randomly placed copies.
    """
    if entry.scatter is not None:
        poses = _scatter_copies(entry.scatter, entry.name, support)
    else:
        if entry.table is not None:
            poses = _read_copies(path(entry.table.file), entry.table)
        else:
            poses = _CopyPoses(
                np.array([(*copy.position, np.nan)[:3] for copy in entry.at]),
                np.array([[getattr(copy, name) for name in _ANGLE_NAMES] for copy in entry.at]),
                np.array([copy.scale for copy in entry.at]),
            )
        poses.set_missing_heights(support)
        poses.check_scales()
    matrices = affine(rotations_of(poses.angles_deg) * poses.scales[:, None], poses.positions)
    return SceneInstance.from_matrices(mesh, matrices, entry.name)


class _CopyPoses(NamedTuple):
    """Poses and scales of the copies that an entry describes."""

    positions: Floats  # (n, 3), world coordinates in meters; z is NaN for copies on a surface
    angles_deg: Floats  # (n, 3), yaw, pitch and roll
    scales: Floats  # (n, 3)

    def set_missing_heights(self, support: SupportSurfaces) -> None:
        """Place copies without a z coordinate on the highest surface at their horizontal position.

        Raise LidarError if there is no such surface.
        """
        positions = self.positions
        rows = np.flatnonzero(np.isnan(positions[:, 2]))
        if len(rows):
            positions[rows, 2], _ = support.heights_below(positions[rows, :2])
        if len(rows := np.flatnonzero(np.isnan(positions[:, 2]))):
            x, y = positions[rows[0], :2].tolist()
            raise LidarError(
                f"There is no upward-facing surface at x {x:g}, y {y:g} to place a copy on. Set "
                f"the z coordinate of {plural(len(rows), 'copy', 'copies')}."
            )

    def check_scales(self) -> None:
        """Raise LidarError if a scale is almost 0."""
        scales = self.scales
        if (np.abs(scales) < MIN_SCALE).any():
            raise LidarError(
                f"The absolute value of a scale must be at least {MIN_SCALE:g}, but a scale is "
                f"{scales.flat[np.abs(scales).argmin()]:g}."
            )


def _read_copies(path: Path, table: CopyTable) -> _CopyPoses:
    try:
        columns = convert_heading(
            read_table(
                read_text(path),
                _COPY_COLUMNS,
                required=lambda columns: ("x", "y"),
                columns=table.columns,
                ignore=table.ignore,
                refused=REFUSED_COLUMNS,
            )
        )
        if "scale" in columns and any(name in columns for name in _SCALE_NAMES):
            raise ValueError(
                "it has both a uniform scale and scales of single axes. Exclude one of them with "
                "`ignore`"
            )
    except (OSError, ValueError, LidarError) as error:
        raise LidarError(
            f"{path} cannot be used as a table of copies: {message_of(error)}"
        ) from error
    count = len(columns["x"])
    if count > MAX_COPIES:
        raise LidarError(f"{path} has {count:,} rows, but the limit is {MAX_COPIES:,}.")

    def columns_of(names: Sequence[str], default: Any) -> Floats:
        return np.stack([columns.get(name, np.full(count, default)) for name in names], axis=1)

    scales = columns_of(("scale",) * 3 if "scale" in columns else _SCALE_NAMES, 1.0)
    return _CopyPoses(columns_of(_POSITION_NAMES, np.nan), stack_angles(columns, count), scales)


def _scatter_copies(scatter: Scatter, name: str, support: SupportSurfaces) -> _CopyPoses:
    """Draw random poses and scales for copies.

    Positions are drawn in a rectangle, and rejected where the highest surface is not one of
    `scatter.surfaces`. Only sums, products and comparisons are used, so that the result is the same
    on all machines.
    """
    # The seed includes the name, so that trees and rocks with the same seed do not coincide.
    seeds = [scatter.seed, *name.encode()]
    positions = _scatter_positions(scatter, seeds, support)
    count = scatter.count
    yaw_and_scale_draws = np.random.Generator(np.random.PCG64([1, *seeds])).random((count, 2))
    yaw = (
        360.0 * yaw_and_scale_draws[:, 0]
        if scatter.yaw_deg is None
        else np.full(count, scatter.yaw_deg)
    )
    min_scale, max_scale = scatter.scale
    scales = min_scale + yaw_and_scale_draws[:, 1] * (max_scale - min_scale)
    angles = np.column_stack([yaw, np.zeros((count, 2))])
    return _CopyPoses(positions, angles, np.repeat(scales[:, None], 3, axis=1))


def _scatter_positions(scatter: Scatter, seeds: list[int], support: SupportSurfaces) -> Floats:
    """Draw random positions on surfaces in world coordinates, in meters.

    `support` contains the surfaces of all objects. If none of the first positions is on a surface
    in `scatter.surfaces`, for example because these surfaces are under a roof, all other surfaces
    are ignored. Raise LidarError if there is not enough space.

    Returns
    -------
    positions
        Shape (count, 3).
    """
    surfaces = support.select(scatter.surfaces)
    x0, y0, x1, y1 = surfaces.rectangle if scatter.within is None else scatter.within
    rng = np.random.Generator(np.random.PCG64([0, *seeds]))
    occupied = _OccupiedPositions(scatter.spacing_m)
    positions: list[Floats] = []
    drawn_count = 0
    while len(positions) < scatter.count:
        if drawn_count > max(MAX_DRAWS, MAX_DRAWS_PER_COPY * scatter.count):
            raise LidarError(
                f"Only {len(positions):,} of {scatter.count:,} copies fit on "
                f"{', '.join(scatter.surfaces)} within x {x0:.6g} to {x1:.6g}, y {y0:.6g} to "
                f"{y1:.6g}. Reduce `count` or `spacing_m`, or choose other `surfaces`."
            )
        draws = rng.random((DRAW_SIZE, 2)) * [x1 - x0, y1 - y0] + [x0, y0]
        heights, objects = support.heights_below(draws)
        on_surfaces = np.flatnonzero(np.isin(objects, surfaces.owners))
        if not drawn_count and not len(on_surfaces):  # the surfaces are probably under a roof
            support = surfaces
            heights, objects = support.heights_below(draws)
            on_surfaces = np.flatnonzero(objects >= 0)
        drawn_count += DRAW_SIZE
        for row in on_surfaces:
            if occupied.try_occupy(*draws[row].tolist()):
                positions.append(np.array([*draws[row], heights[row]]))
                if len(positions) == scatter.count:
                    break
    return np.array(positions)


class _OccupiedPositions:
    """Set of horizontal positions that are at least `spacing_m` apart."""

    def __init__(self, spacing_m: float) -> None:
        self._spacing_m = spacing_m
        # {column and row of a square cell with sides of `spacing_m`: positions}
        self._cells: dict[tuple[int, int], list[tuple[float, float]]] = {}

    def try_occupy(self, x: float, y: float) -> bool:
        """Occupy a position, unless it is too close to an occupied position.

        Return whether the position was occupied by this call.
        """
        spacing_m = self._spacing_m
        if not spacing_m:
            return True
        column = int(x // spacing_m)
        row = int(y // spacing_m)
        for i in (column - 1, column, column + 1):
            for j in (row - 1, row, row + 1):
                for u, v in self._cells.get((i, j), ()):
                    if (x - u) * (x - u) + (y - v) * (y - v) < spacing_m * spacing_m:
                        return False
        self._cells.setdefault((column, row), []).append((x, y))
        return True
