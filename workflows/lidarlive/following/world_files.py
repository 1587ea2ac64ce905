"""Worlds to follow, and models that are spawned while the simulator runs."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lidarscenario.prepare import prepare_actors
from lidarscenario.scenario import Scenario
from lidarscenario.sensors_file import SensorsFile
from lidarscenario.static_scene import read_static_scene
from lidarscenes.files.formats import ROBOTS
from lidarscenes.robots.robot import Robot
from lidarscenes.robots.robot_world import world_of_robot
from lidarscenes.robots.urdf import load_robot
from lidarsim.errors import LidarError, MissingFileError
from lidarsim.media.materials import Material
from lidarsim.scene.files.mesh_formats import endings
from lidarsim.scene.scene_instances import SceneInstance
from lidarsim.scene.transform import affine
from lidarsim.worlds.world import WORLD, World, WorldBody, WorldFrame

_SCENARIOS = (".yaml", ".yml")
_MODEL_FILE = "model.sdf"
_COPY_NUMBER = re.compile(r"[_\-.]?\d+$")  # number at the end of the name of a copy


@dataclass(frozen=True)
class RobotFrames:
    """A robot whose links are frames.

    Attributes
    ----------
    robot
        The robot.
    prefix
        Beginning of the names of its frames.
    """

    robot: Robot
    prefix: str = ""


@dataclass(frozen=True, eq=False)
class FollowedWorld:
    """World of a file, with its robots.

    Attributes
    ----------
    world
        Bodies and frames.
    robots
        Robots whose joints can be controlled.
    materials
        Materials that the file states in the terms of a scenario.
    sensors
        Sensors in the file, or None if it has none.
    """

    world: World
    robots: tuple[RobotFrames, ...] = ()
    materials: tuple[Material, ...] = ()
    sensors: SensorsFile | None = None


def load_followed_world(
    path: Path, assets: Path | None, report: Callable[[str], None]
) -> FollowedWorld:
    """Read a world, a robot or a scenario.

    Parameters
    ----------
    path
        File in a format that `Scene.load` reads, a .urdf file, or a scenario.
    assets
        Additional folder with files to which the world refers.
    report
        Function that is called with notes about content that is not read.

    Raises
    ------
    LidarError
        If the file cannot be read.
    """
    suffix = path.suffix.lower()
    if suffix in _SCENARIOS:
        return _followed_scenario(Scenario.load(path), report)
    if suffix in ROBOTS:
        robot = load_robot(path, assets=assets, report=report)
        return FollowedWorld(world_of_robot(robot), (RobotFrames(robot),))
    options = {} if assets is None else {"assets": assets}
    return FollowedWorld(World.load(path, report=report, **options))


def _followed_scenario(scenario: Scenario, report: Callable[[str], None]) -> FollowedWorld:
    """Return the world of a scenario, whose actors are bodies."""
    if scenario.traffic is not None:
        raise LidarError(
            f"{scenario.source}: `traffic` cannot be followed. Remove it, or list its vehicles as "
            "`actors`."
        )
    with scenario.explain_missing_files():
        static = read_static_scene(scenario)
    scene = static.scene.with_actors(())
    for note in static.findings.notes:
        report(note)
    # The actors in files are relative to the origin of the scene.
    origins = [(actor, scene.origin) for actor in static.scene.actors]
    origins += [(actor, np.zeros(3)) for actor in prepare_actors(scenario).actors]
    bodies = []
    for actor, origin in origins:
        positions, rotations = actor.trajectory.poses(0, np.zeros(1))
        rotation = np.eye(3) if rotations is None else rotations[0]
        matrix = affine(rotation, positions[0] + origin)
        item = SceneInstance(actor.mesh, matrix, actor.name)
        bodies.append(WorldBody(item, actor.name, matrix, is_static=False))
    frames = {body.frame: WorldFrame(WORLD, body.matrix) for body in bodies}
    return FollowedWorld(
        World(tuple(bodies), frames, static=scene),
        materials=tuple(scenario.materials),
        sensors=SensorsFile.from_scenario(scenario),
    )


class ModelFolder:
    """Models that a simulator can spawn.

    A model is a folder with a file model.sdf, or a file in a format that `Scene.load` or
    `load_robot` reads. Its name is that of the folder, or of the file without its extension.

    Parameters
    ----------
    folder
        Folder with the models, or None if there are no models.
    report
        Function that is called with notes about content that is not read.
    """

    def __init__(self, folder: Path | None, report: Callable[[str], None]) -> None:
        self._folder = folder
        self._report = report
        self._files: dict[str, Path] = {}
        self._roots: dict[str, Path] = {}  # {root link of a robot: its file}
        if folder is not None:
            if not folder.is_dir():
                raise MissingFileError(f"{folder} is not a folder. Pass the folder of the models.")
            self._files = dict(_models_in(folder))
            for path in self._files.values():
                if path.suffix.lower() == ROBOTS[0]:
                    self._roots[self._load_robot(path).links[0]] = path

    def find(self, frame: str) -> tuple[str, FollowedWorld] | None:
        """Return the model to which a frame belongs, or None if there is none.

        For example, the frame `crate_2/link` belongs to the model `crate_2`, which is a copy of
        `crate` unless a model has this name.

        Returns
        -------
        tuple
            Name of the model in the simulator, and the model, whose frames have the names that the
            simulator uses.

        Raises
        ------
        LidarError
            If the file of the model cannot be read.
        """
        prefix, _, last = frame.rpartition("/")
        if last in self._roots:
            prefix += "/" * bool(prefix)
            robot = self._load_robot(self._roots[last])
            return frame, FollowedWorld(
                world_of_robot(robot, prefix), (RobotFrames(robot, prefix),)
            )
        name = frame.partition("/")[0]
        path = self._files.get(name) or self._files.get(_COPY_NUMBER.sub("", name))
        if path is None:
            return None
        if path.suffix.lower() == ROBOTS[0]:
            robot = self._load_robot(path)
            world = world_of_robot(robot, f"{name}/")
            return name, FollowedWorld(_inside(world, name), (RobotFrames(robot, f"{name}/"),))
        world = World.load(path, assets=self._folder, report=self._report)
        outer = {body.name.partition("/")[0] for body in world.bodies}
        if len(outer) == 1 and outer <= {*world.frames}:
            return name, FollowedWorld(world.renamed(outer.pop(), name))
        return name, FollowedWorld(_inside(_prefixed(world, f"{name}/"), name))

    def _load_robot(self, path: Path) -> Robot:
        return load_robot(path, assets=self._folder, report=self._report)


def _models_in(folder: Path) -> Iterator[tuple[str, Path]]:
    """Yield the name and the file of each model in a folder."""
    known = {*endings(), ROBOTS[0]}
    for path in sorted(folder.iterdir()):
        if (path / _MODEL_FILE).is_file():
            yield path.name, path / _MODEL_FILE
        elif path.is_file() and path.suffix.lower() in known:
            yield path.stem, path


def _prefixed(world: World, prefix: str) -> World:
    """Return a world in which all names of bodies and frames begin with a prefix."""
    bodies = tuple(
        replace(
            body,
            item=replace(body.item, name=prefix + body.name),
            frame=prefix + body.frame if body.frame != WORLD else WORLD,
        )
        for body in world.bodies
    )
    frames = {
        prefix + name: WorldFrame(frame.parent and prefix + frame.parent, frame.matrix)
        for name, frame in world.frames.items()
    }
    return replace(world, bodies=bodies, frames=frames)


def _inside(world: World, name: str) -> World:
    """Return a world with a new frame at the origin, which is the parent of its root frames."""
    frames = {
        inner: frame._replace(parent=frame.parent or name) for inner, frame in world.frames.items()
    }
    return replace(world, frames={name: WorldFrame(WORLD, np.eye(4)), **frames})
