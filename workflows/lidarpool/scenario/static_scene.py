"""The static part of a scenario's scene: mesh files, copies, the ground and the default objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarscenes.files.formats import ROBOTS
from lidarscenes.robots.robot import Robot
from lidarscenes.robots.urdf import load_robot
from lidarsim.base.arrays import Floats
from lidarsim.base.errors import LidarError, Mistakes, message_of, prefixed
from lidarsim.base.tables import NUMBERS, Quantity, read_table
from lidarsim.base.textfile import read_text
from lidarsim.base.words import plural
from lidarsim.scene.actors import Actor, box, join_meshes
from lidarsim.scene.files.meshfile import Objects, load_objects
from lidarsim.scene.files.scene_graph import ObjectClass, Raster
from lidarsim.scene.object_names import resolve_same_names
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_instances import SceneInstance
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.scene.shapes import seed_objects
from lidarsim.scene.transform import Transform, affine
from lidarsim.scene.wheels import rolling
from lidarsim.sensor.pose_columns import ANGLES, POSITION, REFUSED_COLUMNS, angles_of, with_yaw
from lidarsim.sensor.trajectory import rotations_of

from .ground import Standing
from .scenario import Scenario
from .sections import (
    COPIES_MOST,
    CopiesSection,
    CopyTable,
    MeshFile,
    PathOf,
    Scatter,
    SceneSection,
    ShapeSection,
    file_states,
)

# Fields of a mesh file that a robot that stands still has.
_OF_ROBOTS = {"file", "opacity", "translation", "rotation_deg", "scale", "matrix"}


@dataclass
class Findings:
    """What was noted when a scene was built."""

    notes: list[str] = field(default_factory=list)  # about objects left out of the scene
    remarks: list[str] = field(default_factory=list)  # about axes of files
    sources: dict[str, str] = field(default_factory=dict)  # {file: what it gave}
    rasters: list[tuple[MeshFile, Raster]] = field(default_factory=list)
    # {file of the scene: {number: class}} of files whose format gives classes to objects
    classes: dict[str, Mapping[int, ObjectClass]] = field(default_factory=dict)

    def copy(self) -> Findings:
        """Return the same, to be added to."""
        return Findings(*(found.copy() for found in vars(self).values()))

    def named(self, number: int) -> tuple[str, ...]:
        """Return the patterns of the names of objects that files give a class by its number."""
        patterns = dict.fromkeys(
            pattern
            for classes in self.classes.values()
            if number in classes
            for pattern in classes[number].patterns
        )
        return tuple(patterns)

    @property
    def class_names(self) -> dict[int, str]:
        """Names of the classes that files give to objects, by their numbers in ascending order."""
        names = {
            number: one.name for classes in self.classes.values() for number, one in classes.items()
        }
        return dict(sorted(names.items()))


class StaticScene(NamedTuple):
    """A scene without the actors and traffic of its scenario, and what was noted about it."""

    scene: Scene
    standing: Standing
    found: Findings


class SceneCache:
    """The static scenes that scenarios had last, for others that have the same."""

    def __init__(self, most: int = 4) -> None:
        self._most = most
        self._kept = dict[object, StaticScene]()

    def find(self, scenario: Scenario) -> StaticScene:
        """Return the static scene of a scenario, which is read if it is not kept."""
        key = _key(scenario)
        found = self._kept.pop(key, None) or read_static_scene(scenario)
        self._kept[key] = found  # the last used
        while len(self._kept) > self._most:
            del self._kept[next(iter(self._kept))]
        return found


def _key(scenario: Scenario) -> object:
    """Return what a static scene is made of: equal for scenarios that may share it."""
    section = scenario.scene
    names: list[str] = [entry.file for entry in section.files]
    for copies in section.copies:
        names += [one.file for one in (copies.file, copies.table) if one is not None]
    states = file_states(map(scenario.path, names))
    read_by = scenario.path(""), scenario.coloured, scenario.names_materials, scenario.cloud.epsg
    return section.model_dump_json(), *read_by, states


def read_static_scene(scenario: Scenario) -> StaticScene:
    """Read the mesh files of a scenario, and place its copies and ground.

    Raises
    ------
    LidarError
        If a file cannot be read, or copies have no place.
    """
    section = scenario.scene
    found = Findings()
    shapes = Shapes(scenario, found)
    meshes: list[SceneMesh | SceneInstance] = list(seed_objects()) if section.has_seed else []
    moving: list[Actor] = []
    mistakes = Mistakes()
    for entry in section.files:
        with mistakes.noted():
            objects = shapes.read(entry)
            meshes += objects.static
            moving += objects.actors
            if objects.classes:
                found.classes[entry.file] = objects.classes
    mistakes.tell()
    meshes = resolve_same_names(meshes, section.same_names, found.notes.append)
    if section.copies:
        meshes += _copies(shapes, meshes)
    objects = Objects(tuple(meshes), tuple(moving))
    if section.ground is not None:
        below = Scene.from_meshes(meshes or objects.at_start(lambda _: None))
        objects = objects._replace(static=(*meshes, _ground(section, below)))
    scene = Scene.from_objects(objects, found.notes.append)
    return StaticScene(scene, Standing(scene), found)


class Shapes:
    """Meshes and robots of a scenario, each file read once; `found` is added to."""

    def __init__(self, scenario: Scenario, found: Findings) -> None:
        self.scenario = scenario
        self.found = found
        self._made: dict[Any, SceneMesh] = {}  # {file or size: mesh}
        self._robots: dict[MeshFile, Robot] = {}

    def of(self, entry: ShapeSection) -> SceneMesh:
        """Return the mesh of a copy, an actor or vehicles, under any name."""
        shape = entry.file or entry.box or (1.0, 1.0, 1.0)
        made = self._made
        animation, wheels = (getattr(entry, name, None) for name in ("animation", "wheels"))
        played = animation and (animation.name, animation.speed_m_s, animation.repeat)
        key = shape, played, wheels
        if key not in made:
            name = entry.name or "vehicle"
            if not isinstance(shape, MeshFile):
                return made.setdefault(key, box(name, shape))
            read = self.read(shape, animation and (animation.name or ""))
            path = self.scenario.path(shape.file)
            still = read.at_start(lambda line: self.found.notes.append(f"{path} moves {line}"))
            if wheels is not None:
                with prefixed(path):
                    still = (*rolling(still, wheels, self.found.notes.append),)
            mesh = made[key] = join_meshes(name, still)
            if animation is not None and mesh.animation is not None:
                own = {"speed_m_s": animation.speed_m_s, "repeat": animation.repeat}
                made[key] = replace(mesh, animation=replace(mesh.animation, **own))
        return made[key]

    def robot(self, entry: MeshFile) -> Robot:
        """Return the robot of a file; LidarError if it cannot be used."""
        if entry not in self._robots:
            path = self.scenario.path(entry.file)
            tell = self.found.notes.append
            colours = self.scenario.coloured
            named = self.scenario.names_materials
            made = load_robot(
                path, opacity=entry.opacity, colours=colours, materials=named, tell=tell
            )
            self._robots[entry] = made
            self.found.sources[entry.file] = made.summary
        return self._robots[entry]

    def read(self, entry: MeshFile, animation: str | None = None) -> Objects:
        """Read the objects of a file, with an animation; LidarError if it cannot be used."""
        scenario = self.scenario
        found = self.found
        with prefixed(scenario.source):
            transform = entry.transform()
        if entry.file.lower().endswith(ROBOTS):
            return self._still_robot(entry, transform)
        objects = load_objects(
            scenario.path(entry.file),
            **entry.model_dump(include={"unit", "up_axis", "opacity", "step_m", "window"}),
            transform=transform,
            colours=scenario.coloured,
            materials=scenario.names_materials,
            epsg=scenario.cloud.epsg,
            assets=None if entry.assets is None else scenario.path(entry.assets),
            animation=animation,
            tell=found.notes.append,
            axes=found.remarks.append,
        )
        found.sources.setdefault(entry.file, objects.summary)
        if objects.raster is not None:
            found.rasters.append((entry, objects.raster))
        return objects

    def _still_robot(self, entry: MeshFile, transform: Transform) -> Objects:
        """Return a robot with its joints at zero."""
        if other := sorted(entry.model_fields_set - _OF_ROBOTS):
            raise LidarError(
                f"{self.scenario.path(entry.file)} is a robot, which is in metres and Z-up: leave "
                f"out {' and '.join(other)}."
            )
        robot = self.robot(entry)
        tell = self.found.notes.append
        if robot.moving:
            tell(f"{entry.file} has its joints at zero; joints of an actor move them")
        links = Objects((), robot.actors(tell=tell)).at_start(lambda _: None)
        return Objects(tuple(o.moved(o.name, transform.linear, transform.offset) for o in links))


def _copies(shapes: Shapes, base: list[SceneMesh | SceneInstance]) -> list[SceneInstance]:
    """Place the copies; they stand on other objects and on the ground, not on one another."""
    scenario = shapes.scenario
    section = shapes.scenario.scene
    scene = Scene.from_meshes(base) if base else None
    if section.ground is not None and (base or _copied_to(section)):
        scene = Scene.from_meshes([*base, _ground(section, scene)])
    standing = Standing(scene)
    out: list[SceneInstance] = []
    mistakes = Mistakes()
    for number, entry in enumerate(section.copies):
        with mistakes.noted():
            mesh = shapes.of(entry)
            with prefixed(f"{scenario.source}: scene.copies[{number}]"):
                made = copies_of(entry, mesh, standing, scenario.path)
            if entry.file is not None:
                words = f", {plural(len(made), 'copy', 'copies')}"
                shapes.found.sources[entry.file.file] += words
            out += made
    mistakes.tell()
    return out


def _copied_to(section: SceneSection) -> list[Floats]:
    """Corners of where copies are scattered, and places of lists, each (n, 2)."""
    scattered = [entry.scatter for entry in section.copies if entry.scatter is not None]
    listed = [[one.position[:2] for one in entry.at] for entry in section.copies]
    return [
        *(np.reshape(one.within, (2, 2)) for one in scattered if one.within is not None),
        *(np.array(places, np.float64) for places in listed if places),
    ]


def _ground(section: SceneSection, scene: Scene | None) -> SceneMesh:
    """Two triangles under a scene, and under where copies are scattered or listed."""
    ground = section.ground
    assert ground is not None, "of a section with a ground"
    ends = [] if scene is None else [(scene.bounds + scene.origin)[:, :2]]
    points = np.concatenate([*ends, *_copied_to(section)])
    (x0, y0), (x1, y1) = points.min(axis=0) - ground.margin_m, points.max(axis=0) + ground.margin_m
    z = ground.height_m
    corners = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]])
    return SceneMesh("Ground", corners, np.array([[0, 1, 2], [0, 2, 3]]))


SCALE_LEAST = 1e-6
DRAWN = 1 << 14  # places that are drawn at a time
DRAWS_MOST = 200  # places that are drawn for each copy, if not fewer than
DRAWS_LEAST = 1 << 21

_PLACE = ("x", "y", "z")
_ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")
_SCALES = ("scale_x", "scale_y", "scale_z")
_COPY_COLUMNS = (
    *POSITION,
    *ANGLES,
    *(Quantity(name, (name,), NUMBERS, "") for name in ("scale", *_SCALES)),
)


def copies_of(
    entry: CopiesSection, mesh: SceneMesh, standing: Standing, path: PathOf
) -> list[SceneInstance]:
    """Place the copies of an entry; `path` returns that of its table.

    Raises
    ------
    LidarError
        If a table cannot be read, a place has no surface to stand on, or there is no room.
    """
    if entry.scatter is not None:
        places, angles, scales = _scattered(entry.scatter, entry.name, standing)
    else:
        if entry.table is not None:
            places, angles, scales = _of_table(path(entry.table.file), entry.table)
        else:
            places = np.array([(*one.position, np.nan)[:3] for one in entry.at])
            angles = np.array([[getattr(one, name) for name in _ANGLES] for one in entry.at])
            scales = np.array([one.scale for one in entry.at])
        low = np.flatnonzero(np.isnan(places[:, 2]))
        if len(low):
            places[low, 2], _ = standing.under(places[low, :2])
        if len(low := np.flatnonzero(np.isnan(places[:, 2]))):
            x, y = places[low[0], :2].tolist()
            raise LidarError(
                f"below x {x:g}, y {y:g} nothing of the scene's files or ground faces up to stand "
                f"on ({plural(len(low), 'copy', 'copies')}): give z."
            )
        if (np.abs(scales) < SCALE_LEAST).any():
            raise LidarError(
                f"a scale of {scales.flat[np.abs(scales).argmin()]:g} would flatten the mesh: give "
                f"at least {SCALE_LEAST:g}."
            )
    matrices = affine(rotations_of(angles) * scales[:, None], places)
    return SceneInstance.from_matrices(mesh, matrices, entry.name)


def _of_table(path: Path, table: CopyTable) -> tuple[Floats, Floats, Floats]:
    """Read positions, z nan if there is none, angles in degrees, and scales: (n, 3) each."""
    try:
        columns = with_yaw(
            read_table(
                read_text(path),
                _COPY_COLUMNS,
                required=lambda columns: ("x", "y"),
                columns=table.columns,
                ignore=table.ignore,
                refused=REFUSED_COLUMNS,
            )
        )
        if "scale" in columns and any(name in columns for name in _SCALES):
            raise ValueError("it has both scale and scales of axes: ignore one")
    except (OSError, ValueError, LidarError) as error:
        raise LidarError(f"{path} is not a usable table of copies: {message_of(error)}") from error
    count = len(columns["x"])
    if count > COPIES_MOST:
        raise LidarError(f"{path} has {count:,} rows; at most {COPIES_MOST:,} are allowed.")

    def some(names: Sequence[str], default: Any) -> Floats:
        return np.stack([columns.get(name, np.full(count, default)) for name in names], axis=1)

    scales = some(("scale",) * 3 if "scale" in columns else _SCALES, 1.0)
    return some(_PLACE, np.nan), angles_of(columns, count), scales


def _scattered(given: Scatter, name: str, standing: Standing) -> tuple[Floats, Floats, Floats]:
    """Places, angles in degrees and scales of copies at random: (n, 3) each.

    Places are drawn in a rectangle and kept if the highest surface there is one of those named:
    only sums, products and comparisons, so that all machines draw the same.
    """
    own = standing.only(given.surfaces)
    x0, y0, x1, y1 = own.rectangle if given.within is None else given.within
    # The name, so that trees and rocks of one seed are not at the same places.
    seeds = [given.seed, *name.encode()]
    draw = np.random.Generator(np.random.PCG64([0, *seeds]))
    room = _TakenPlaces(given.spacing_m)
    found: list[Floats] = []
    drawn = 0
    while len(found) < given.count:
        if drawn > max(DRAWS_LEAST, DRAWS_MOST * given.count):
            raise LidarError(
                f"only {len(found):,} of {given.count:,} found room on {', '.join(given.surfaces)} "
                f"within x {x0:.6g} to {x1:.6g}, y {y0:.6g} to {y1:.6g}: take fewer, a smaller "
                "spacing_m, or other surfaces."
            )
        block = draw.random((DRAWN, 2)) * [x1 - x0, y1 - y0] + [x0, y0]
        heights, objects = standing.under(block)
        on = np.flatnonzero(np.isin(objects, own.owners))
        if not drawn and not len(on):  # they are under a roof: draw the same again without it
            standing = own
            heights, objects = standing.under(block)
            on = np.flatnonzero(objects >= 0)
        drawn += DRAWN
        for row in on:
            x, y = block[row].tolist()
            if room.takes(x, y):
                found.append(np.array([x, y, heights[row]]))
                if len(found) == given.count:
                    break
    looks = np.random.Generator(np.random.PCG64([1, *seeds])).random((given.count, 2))
    yaw = 360.0 * looks[:, 0] if given.yaw_deg is None else np.full(given.count, given.yaw_deg)
    least, largest = given.scale
    scales = least + looks[:, 1] * (largest - least)
    angles = np.column_stack([yaw, np.zeros((given.count, 2))])
    return np.array(found), angles, np.repeat(scales[:, None], 3, axis=1)


class _TakenPlaces:
    """Places that are taken, each with so much room around it."""

    def __init__(self, spacing_m: float) -> None:
        self._apart = spacing_m
        self._taken: dict[tuple[int, int], list[tuple[float, float]]] = {}  # {cell: places}

    def takes(self, x: float, y: float) -> bool:
        """Take a place, if no other is too near."""
        apart = self._apart
        if not apart:
            return True
        column = int(x // apart)
        row = int(y // apart)
        for i in (column - 1, column, column + 1):
            for j in (row - 1, row, row + 1):
                for u, v in self._taken.get((i, j), ()):
                    if (x - u) * (x - u) + (y - v) * (y - v) < apart * apart:
                        return False
        self._taken.setdefault((column, row), []).append((x, y))
        return True
