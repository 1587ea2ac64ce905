"""Builds what a scenario describes: the scene, the survey and the planning."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from glob import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..base.arrays import Floats
from ..base.declared import declared
from ..base.errors import LidarpoolError, Mistakes, prefixed
from ..base.words import counted, did_you_mean
from ..export.table import check_whole
from ..plan import Planning
from ..plan.planning import Search
from ..scene.actors import Actor
from ..scene.cityjson import CLASSES as CITY_CLASSES
from ..scene.mesh import Mesh
from ..scene.meshfile import CITYJSON
from ..scene.robot import Robot
from ..scene.scene import Scene
from ..scene.urdf import load_robot
from ..sensor import Material, Mounted, Noise, Pose, Returns, Survey, Track
from ..sensor.materials import MaterialTable, rows_named, with_class, with_classes
from ..sensor.survey import CloudOptions
from ..sensor.trajectory import CENTRE
from ..sensor.weather import Weather
from .moving import ActorSection, MountSection
from .placing import Placing, place
from .scenario import Scenario
from .sections import CopiesSection, MeshFile, SensorSection
from .standing import Standing
from .static_scene import Findings, SceneCache, mesh_of, read_static_scene
from .traffic import VehicleSection, actors_of, read_fcd

# Objects lower than this are floors and markings, which a path may cross.
FLAT_M = 0.2

SEED_START = (25.0, 25.0)
SEED_TARGET = (-30.0, -20.0)
SEED_POSES = tuple(Pose((0.0, 0.0, height)) for height in (1.0, 2.0, 3.0))

# Of the hits in a scene with the default objects, every so many are kept.
SEED_KEPT = 5

Robots = dict[MeshFile | None, Robot]  # {their file: robot}


@dataclass(frozen=True, eq=False)
class Built:
    """What a scenario describes.

    Parameters
    ----------
    scenario
        What it was built of.
    scene, survey, planning
        In the scene's local coordinates; the planning is None for none.
    placing
        Where the sensor was put, if the scenario has no poses; else None.
    found
        What was noted meanwhile, and what each file gave.
    """

    scenario: Scenario
    scene: Scene
    survey: Survey
    planning: Planning | None
    placing: Placing | None
    found: Findings


class _Frame(NamedTuple):
    """Where a survey takes place: local coordinates of a scene, sensors, and their way."""

    origin: Floats
    sensors: list[Mounted]
    track: Track | None
    poses: list[Pose]
    epsg: int | None


def build(
    scenario: Scenario,
    *,
    plans: bool = True,
    cache: SceneCache | None = None,
    columns: Sequence[str] = (),
) -> Built:
    """Read the files of a scenario and build what it describes.

    Parameters
    ----------
    plans
        Whether to build the planning.
    cache
        Static scenes of other scenarios, which this one may share.
    columns
        Names of columns that the cloud gets beside those of the scenario.

    Raises
    ------
    LidarpoolError
        If a file cannot be read, or fields do not fit together or the scene.
    """
    static = read_static_scene(scenario) if cache is None else cache.find(scenario)
    scene, standing, found = static.scene, static.standing, static.found.copy()
    robots = _robots(scenario, found)
    epsg = _common_epsg(scenario, found)
    with prefixed(scenario.source):
        way = scenario.trajectory
        track = None if way is None else way.track(scenario.path, standing)
        sensors = _sensors(scenario, robots)
    placing = None
    if scenario.poses is None and track is None and not scenario.scene.has_seed:
        placing = place(scene, sensors[0], landscape=bool(found.rasters))
    frame = _Frame(scene.origin, sensors, track, _poses(scenario, placing, scene.origin), epsg)
    vehicles: list[tuple[Actor, VehicleSection]] = []
    if scenario.actors or scenario.traffic:
        actors = _actors(scenario, robots, standing, track, found)
        vehicles = _vehicles(scenario, frame, standing, found)
        traffic = (actor for actor, _ in vehicles)
        scene = scene.with_actors([*scene.actors, *actors, *traffic])
    survey, planning, mistakes = None, None, Mistakes()
    with mistakes.noted():
        classes = [entry.semantic_class for _, entry in vehicles]
        with prefixed(scenario.source):
            survey = _survey(scenario, frame, _materials(scenario, scene, classes), columns)
        MaterialTable.of(survey.materials, scene.all_names, voxels=scene.has_voxels)
    with mistakes.noted(), prefixed(scenario.source):
        planning = _planning(scenario, scene) if plans else None
    mistakes.tell()
    assert survey is not None, "without mistakes"
    return Built(scenario, scene, survey, planning, placing, found)


def _robots(scenario: Scenario, found: Findings) -> Robots:
    """Read the robots, each file once."""
    robots: Robots = {}
    for file in (entry.file for entry in scenario.actors if entry.is_robot):
        if file is not None and file not in robots:
            with prefixed(scenario.source):
                path = scenario.path(file.file)
            robots[file] = load_robot(
                path, opacity=file.opacity, colours=scenario.coloured, tell=found.notes.append
            )
            found.sources[file.file] = robots[file].summary
    return robots


def _common_epsg(scenario: Scenario, found: Findings) -> int | None:
    """EPSG code of the rasters that stay where they are; they must be of one system."""
    stay = [(e.file, raster) for e, raster in found.rasters if e.transform().keeps_xy]
    systems = {raster.crs: file for file, raster in stay if raster.crs}
    if len(systems) > 1:
        listed = ", ".join(f"{file} in {crs[:60]}" for crs, file in systems.items())
        raise LidarpoolError(
            f"{scenario.source}: rasters of one scene have several coordinate systems: {listed}. "
            "Give cloud.epsg, the code of the one that all of them are brought to."
        )
    return next((raster.epsg for _, raster in stay if raster.crs), None)


def _sensors(scenario: Scenario, robots: Robots) -> list[Mounted]:
    """Return the sensors on their carrier."""
    sections: Mapping[str, SensorSection] = scenario.sensors or {"": scenario.sensor}
    mounts = {name: getattr(one, "mount", scenario.mount) for name, one in sections.items()}
    common = scenario.noise, scenario.returns
    return [
        section.mounted(scenario.path, _mount(scenario, mounts[name], robots), *common, name)
        for name, section in sections.items()
    ]


def _mount(scenario: Scenario, mount: MountSection | None, robots: Robots) -> Pose:
    """Pose of a sensor in the carrier's axes."""
    if mount is None or mount.link is None:
        return CENTRE if mount is None else mount.pose()
    carriers = [one for one in scenario.actors if one.trajectory is None and one.is_robot]
    on = [entry for entry in carriers if mount.link in robots[entry.file].links]
    if len(on) != 1:
        links = [link for entry in carriers for link in robots[entry.file].links]
        raise LidarpoolError(
            f"mount.link is {mount.link!r}, which {len(on) or 'no'} robots on the carrier "
            f"have; one must.{did_you_mean(mount.link, links)}"
        )
    (entry,) = on
    with prefixed(f"actor {entry.name!r}"):
        path = robots[entry.file].path(mount.link, joints=_joints(scenario, entry))
    if path.moves:
        raise LidarpoolError(
            f"mount.link is {mount.link!r}, which {entry.joints} moves, and a mount is rigid: "
            "mount the sensor on a link that does not move, or leave out those joints' columns."
        )
    return path.pose(0).then(mount.pose())


def _joints(scenario: Scenario, entry: ActorSection) -> Path | None:
    return None if entry.joints is None else scenario.path(entry.joints)


def _poses(scenario: Scenario, placing: Placing | None, origin: Floats) -> list[Pose]:
    """Poses of the sensor in local coordinates; none if it follows a trajectory."""
    if scenario.trajectory is not None:
        return []
    poses = SEED_POSES if placing is None else placing.poses
    if scenario.poses is not None:
        poses = scenario.poses
    return [replace(one, position=tuple(np.subtract(one.position, origin))) for one in poses]


def _actors(
    scenario: Scenario, robots: Robots, standing: Standing, carrier: Track | None, found: Findings
) -> list[Actor]:
    """Build the actors; their trajectories begin with that of the survey."""
    shapes: dict[Any, Mesh] = {}
    with prefixed(scenario.source):
        ways = [entry.way(scenario.path, standing, carrier) for entry in scenario.actors]
    out: list[Actor] = []
    for entry, way in zip(scenario.actors, ways, strict=True):
        if entry.is_robot:
            with prefixed(f"{scenario.source}: actor {entry.name!r}"):
                out += _links(scenario, entry, robots[entry.file], way, found.notes.append)
        else:
            mesh = mesh_of(scenario, entry, shapes, found)
            out.append(Actor(replace(mesh, name=entry.name), way))
    return out


def _links(
    scenario: Scenario, entry: ActorSection, robot: Robot, way: Track, tell: Callable[[str], None]
) -> Sequence[Actor]:
    """Actors of a robot, without the links that sensors are mounted on."""
    without = scenario.links.intersection(robot.meshes) if entry.trajectory is None else ()
    for link in sorted(without):
        tell(f"{entry.name}: link {link} is left out: a sensor is mounted on it")
    joints = _joints(scenario, entry)
    return robot.actors(way, joints, name=entry.name, without=without, tell=tell)


def _vehicles(
    scenario: Scenario, frame: _Frame, standing: Standing, found: Findings
) -> list[tuple[Actor, VehicleSection]]:
    """Vehicles and persons that are there during the survey, each with its entry."""
    section = scenario.traffic
    if section is None:
        return []
    start_s = 0.0 if frame.track is None else frame.track.start_s or 0.0
    shape_of = partial(mesh_of, scenario, made={}, found=found)
    with prefixed(scenario.source):
        duration = _survey(scenario, frame, []).duration_ns / 1e9
        begin = start_s - section.offset_s
        passages, count = read_fcd(scenario.path(section.file), begin, begin + duration)
        made = actors_of(section, passages, shape_of, standing, start_s)
    if not made:
        found.notes.append(
            f"{section.file}: no vehicle or person is in the scene from {begin:g} to "
            f"{begin + duration:g} s of the file: check offset_s, translation and surfaces"
        )
    found.sources[section.file] = (
        f"{counted(len(made), 'actor')} during the survey, of {counted(count, 'vehicle')} "
        "and persons until its end"
    )
    return made


def _materials(scenario: Scenario, scene: Scene, vehicles: Sequence[int | None]) -> list[Material]:
    """Materials by name, with the classes of actors and copies, and of city objects.

    `vehicles` are the classes of the last actors of the scene.
    """
    made = [*scenario.materials]
    placed: tuple[CopiesSection | ActorSection, ...] = (*scenario.scene.copies, *scenario.actors)
    own: list[tuple[str, list[str], int]] = []  # an object, names of all, their class
    for entry in placed:
        if entry.semantic_class is None:
            continue
        names, numbered = [escape(entry.name)], f"{escape(entry.name)}.[0-9]*"
        if isinstance(entry, CopiesSection) and len(rows_named(numbered, scene.names)):
            names.append(numbered)
        if isinstance(entry, ActorSection) and entry.is_robot:
            links = [a.name for a in scene.actors if a.name.startswith(f"{entry.name}/")]
            own += [(link, [escape(link)], entry.semantic_class) for link in links]
        else:
            own.append((entry.name, names, entry.semantic_class))
    if own and not made:
        made = [Material("*")]
    for name, names, semantic_class in own:
        # After the last that is for it: a later one, for a single copy, counts there.
        after = max((k for k, m in enumerate(made) if m.named(name)), default=-1)
        of = made[after] if after >= 0 else Material("*")
        made.insert(after + 1, replace(of, objects=names, semantic_class=semantic_class))
    first = len(scene.all_names) - len(vehicles)
    for semantic_class in sorted({one for one in vehicles if one is not None}):
        rows = np.array([first + k for k, one in enumerate(vehicles) if one == semantic_class])
        made = with_class(made or [Material("*")], semantic_class, rows, scene.all_names)
    if any(entry.file.lower().endswith(CITYJSON) for entry in scenario.scene.files):
        made = with_classes(made or [Material("*")], CITY_CLASSES, scene.all_names)
    return made


def _survey(
    scenario: Scenario, frame: _Frame, materials: list[Material], columns: Sequence[str] = ()
) -> Survey:
    """Build the survey, its poses in local coordinates."""
    needs, carried = scenario.output.needs, frame.sensors
    cloud = declared(scenario.cloud, CloudOptions)
    cloud["columns"] = (*scenario.cloud.columns, *needs, *columns)
    cloud["epsg"] = scenario.cloud.epsg or frame.epsg
    if scenario.scene.has_seed and cloud["keep_every"] is None:
        cloud["keep_every"] = 1 if "ray" in needs else SEED_KEPT
    check_whole((*needs, *columns), cloud["keep_every"] or 1)
    own_noise = all(one.noise is not None for one in carried)
    alone = not scenario.sensors and scenario.mount is None and carried[0].noise is None
    return Survey(
        poses=frame.poses,
        trajectory=frame.track,
        **({"sensor": carried[0].sensor} if alone else {"sensors": carried}),
        steps=scenario.steps,
        materials=materials,
        returns=Returns(**dict(scenario.returns)),
        noise=Noise() if own_noise else Noise(**dict(scenario.noise)),
        navigation=scenario.navigation,
        **declared(scenario.weather, Weather),
        **cloud,
    )


def _planning(scenario: Scenario, scene: Scene) -> Planning | None:
    """Build the planning in local coordinates; None if the scenario asks for none."""
    section = scenario.planning
    start, target = section.start, section.target
    if scenario.scene.has_seed:
        start, target = start or SEED_START, target or SEED_TARGET
    if section.enabled is False or start is None or target is None:
        return None
    discs, labels = _discs(scenario, scene)
    discs[:, 2] += section.clearance_m
    wide = np.flatnonzero(discs[:, 2])  # upright lines have no area
    discs, labels = discs[wide], [labels[i] for i in wide]
    x0, y0, _ = scene.origin
    local = [(x - x0, y - y0) for x, y in (start, target)]
    _check_free({"start": local[0], "target": local[1]}, discs, labels)
    return Planning(
        start=local[0],
        target=local[1],
        centres=discs[:, :2],
        radii=discs[:, 2],
        **declared(section, Search),
    )


def _discs(scenario: Scenario, scene: Scene) -> tuple[Floats, list[str]]:
    """Obstacles as local x, y, radius (m, 3), and a label for each."""
    if scenario.planning.obstacles is None:
        tall = np.flatnonzero(np.ptp(scene.object_bounds[..., 2], axis=1) >= FLAT_M)
        return scene.footprints[tall], [scene.names[i] for i in tall]
    rows: dict[str, list[float]] = {}  # {label: x, y, radius}
    for number, entry in enumerate(scenario.planning.obstacles):
        if entry.object is None:
            assert entry.centre and entry.radius_m, "either of the two kinds is given"
            centre = np.subtract(entry.centre, scene.origin[:2])
            rows[f"planning.obstacles[{number}]"] = [*centre, entry.radius_m]
            continue
        # An exact name comes first, even with brackets; else it is a pattern.
        found = [i for i, name in enumerate(scene.names) if name == entry.object] or [
            i for i, name in enumerate(scene.names) if fnmatchcase(name, entry.object)
        ]
        if not found:
            hint = did_you_mean(entry.object, scene.names)
            raise LidarpoolError(
                f"planning.obstacles names {entry.object!r}, but no object has that name."
                + (hint or f" The scene has {', '.join(scene.names[:5])}, …")
            )
        rows |= {scene.names[i]: list(scene.footprints[i]) for i in found}
    return np.array(list(rows.values()), dtype=np.float64).reshape(-1, 3), list(rows)


def _check_free(ends: dict[str, tuple[float, float]], discs: Floats, labels: list[str]) -> None:
    """Refuse a path that begins or ends in an obstacle, and name the obstacle."""
    for end, point in ends.items():
        inside = np.hypot(*(discs[:, :2] - point).T) < discs[:, 2]
        if inside.any():
            first = int(inside.argmax())
            raise LidarpoolError(
                f"planning.{end} lies {discs[first, 2]:.2f} m or less from the middle of "
                f"{labels[first]}, within its circle: move it, or list other planning.obstacles."
            )
