"""The static part of a scenario's scene: mesh files, copies, the ground and the default objects."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..base.arrays import Floats
from ..base.errors import Mistakes, prefixed
from ..base.words import counted
from ..scene.actors import Actor, box, one_mesh
from ..scene.instances import Instance
from ..scene.mesh import Mesh
from ..scene.meshfile import Objects, load_objects
from ..scene.nodes import Raster
from ..scene.scene import Scene
from ..scene.shapes import seed_objects
from .copies import copies_of
from .scenario import Scenario
from .sections import MeshFile, SceneSection, ShapeSection, file_states
from .standing import Standing


@dataclass
class Findings:
    """What was noted when a scene was built."""

    notes: list[str] = field(default_factory=list)  # about objects left out of the scene
    remarks: list[str] = field(default_factory=list)  # about axes of files
    sources: dict[str, str] = field(default_factory=dict)  # {file: what it gave}
    rasters: list[tuple[MeshFile, Raster]] = field(default_factory=list)

    def copy(self) -> Findings:
        """Return the same, to be added to."""
        return Findings(*(found.copy() for found in vars(self).values()))


class StaticScene(NamedTuple):
    """A scene without the actors and traffic of its scenario, and what was noted about it."""

    scene: Scene
    standing: Standing
    found: Findings


class SceneCache:
    """The static scenes that scenarios had last, for others that have the same."""

    def __init__(self, most: int = 4) -> None:
        self._most, self._kept = most, dict[object, StaticScene]()

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
    states = file_states(scenario.paths(names))
    read_by = scenario.folder, scenario.coloured, scenario.cloud.epsg
    return section.model_dump_json(), *read_by, states


def read_static_scene(scenario: Scenario) -> StaticScene:
    """Read the mesh files of a scenario, and place its copies and ground.

    Raises
    ------
    LidarpoolError
        If a file cannot be read, or copies have no place.
    """
    section, found = scenario.scene, Findings()
    meshes: list[Mesh | Instance] = list(seed_objects()) if section.has_seed else []
    moving: list[Actor] = []
    mistakes = Mistakes()
    for entry in section.files:
        with mistakes.noted():
            read = _read(scenario, entry, found)
            meshes += read.standing
            moving += read.moving
    mistakes.tell()
    if section.copies:
        meshes += _copies(scenario, meshes, found)
    objects = Objects(tuple(meshes), tuple(moving))
    if section.ground is not None:
        below = Scene.from_meshes(meshes or objects.still(lambda _: None))
        objects = objects._replace(standing=(*meshes, _ground(section, below)))
    scene = Scene.of_objects(objects, found.notes.append)
    return StaticScene(scene, Standing(scene), found)


def mesh_of(
    scenario: Scenario, entry: ShapeSection, made: dict[Any, Mesh], found: Findings
) -> Mesh:
    """Return the mesh of an entry, of those in `made` if it is there: {file or size: mesh}."""
    shape = entry.file or entry.box or (1.0, 1.0, 1.0)
    if shape not in made:
        name = entry.name or "vehicle"
        if isinstance(shape, MeshFile):
            lost = f"{scenario.path(shape.file)} moves "
            read = _read(scenario, shape, found)
            made[shape] = one_mesh(name, read.still(lambda line: found.notes.append(lost + line)))
        else:
            made[shape] = box(name, shape)
    return made[shape]


def _read(scenario: Scenario, entry: MeshFile, found: Findings) -> Objects:
    with prefixed(scenario.source):
        path, transform = scenario.path(entry.file), entry.transform()
        assets = None if entry.assets is None else scenario.path(entry.assets)
    return load_objects(
        path,
        unit=entry.unit,
        up_axis=entry.up_axis,
        transform=transform,
        opacity=entry.opacity,
        colours=scenario.coloured,
        step_m=entry.step_m,
        window=entry.window,
        epsg=scenario.cloud.epsg,
        assets=assets,
        tell=found.notes.append,
        axes=found.remarks.append,
        tell_raster=lambda raster: found.rasters.append((entry, raster)),
        taken=partial(found.sources.setdefault, entry.file),
    )


def _copies(scenario: Scenario, base: list[Mesh | Instance], found: Findings) -> list[Instance]:
    """Place the copies; they stand on other objects and on the ground, not on one another."""
    section = scenario.scene
    scene = Scene.from_meshes(base) if base else None
    if section.ground is not None and (base or _copied_to(section)):
        scene = Scene.from_meshes([*base, _ground(section, scene)])
    standing = Standing(scene)
    shapes: dict[Any, Mesh] = {}
    out: list[Instance] = []
    mistakes = Mistakes()
    for number, entry in enumerate(section.copies):
        with mistakes.noted():
            mesh = mesh_of(scenario, entry, shapes, found)
            with prefixed(f"{scenario.source}: scene.copies[{number}]"):
                table = scenario.path(entry.table.file) if entry.table else None
                made = copies_of(entry, mesh, standing, table)
            if entry.file is not None:
                words = f", {counted(len(made), 'copy', 'copies')}"
                found.sources[entry.file.file] += words
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


def _ground(section: SceneSection, scene: Scene | None) -> Mesh:
    """Two triangles under a scene, and under where copies are scattered or listed."""
    ground = section.ground
    assert ground is not None, "of a section with a ground"
    ends = [] if scene is None else [(scene.bounds + scene.origin)[:, :2]]
    points = np.concatenate([*ends, *_copied_to(section)])
    (x0, y0), (x1, y1) = points.min(axis=0) - ground.margin_m, points.max(axis=0) + ground.margin_m
    z = ground.height_m
    corners = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]])
    return Mesh("Ground", corners, np.array([[0, 1, 2], [0, 2, 3]]))
