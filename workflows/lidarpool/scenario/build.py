"""Builds what a scenario describes: the scene, the survey and the planning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cached_property, partial
from glob import escape
from typing import Any

import numpy as np

from lidarscenes.robots.robot import Robot
from lidarsim.base.arrays import Floats
from lidarsim.base.declared import declared
from lidarsim.base.errors import LidarError, Mistakes, prefixed
from lidarsim.base.validation import checked_fields
from lidarsim.base.words import did_you_mean, plural
from lidarsim.scene.actors import Actor, check_spray
from lidarsim.scene.scene import Scene
from lidarsim.sensor import Material, Mounted, Noise, Pose, Returns, Sensor, Survey, Track
from lidarsim.sensor.materials import MaterialTable, rows_named, with_class, with_classes
from lidarsim.sensor.survey import CloudOptions
from lidarsim.sensor.trajectory import CENTRE
from lidarsim.sensor.weather import Weather
from lidarsim.simulator.surfaces import warn_of_grey
from lidarsim.sweeps.sweeps import Sweeps

from ..export.format_table import check_whole
from ..export.formats import Format
from ..export.laser_scan import with_laser_scans
from ..plan import Planning
from ..plan.planning import Search
from .actor_motion import (
    ActorSection,
    MountSection,
    TrafficSection,
    VehicleSection,
    actors_of,
    read_fcd,
)
from .ground import Standing
from .placing import Placing, place
from .scenario import Scenario
from .sections import CopiesSection, SensorSection
from .static_scene import Findings, SceneCache, Shapes, read_static_scene

# Objects lower than this are floors and markings, which a path may cross.
FLAT_M = 0.2

SEED_START = (25.0, 25.0)
SEED_TARGET = (-30.0, -20.0)
SEED_POSES = tuple(Pose((0.0, 0.0, height)) for height in (1.0, 2.0, 3.0))

# Of the hits in a scene with the default objects, every so many are kept.
SEED_KEPT = 5

# Class of buildings by ASPRS LAS: sensors are not placed in objects that a file gives this class.
BUILDING = 6

# Precision of points in scenes without these, if no sensor states a resolution.
MESH_PRECISION_M = 0.001


@dataclass(frozen=True, eq=False)
@checked_fields
class Job:
    """A survey of a scene, possibly with path planning; in a `Campaign`, one of many.

    A function that makes jobs for a `Campaign` gives scene, survey and values: the campaign
    numbers, names and splits them.

    Parameters
    ----------
    scene, survey, planning
        As for `simulate`: in the scene's local coordinates.
    values
        What differs from job to job: {name: number, text, or True and False}; None for an empty
        cell. All jobs of a campaign have the same names, the columns of its table.
    number, name, split
        Its number in its campaign, its name in files, and the name of its split.
    outputs
        Formats that its cloud is also written in.
    made_of
        Names and SHA-256 of the files that it was made of.

    Raises
    ------
    LidarError
        If something is of another type, the survey's precision is too fine for the scene, a
        material is for no object, or an object lacks a material while others have one.
    """

    scene: Scene
    survey: Survey
    planning: Planning | None = None
    values: Mapping[str, Any] = field(default_factory=dict)
    number: int = 0
    name: str = ""
    split: str = ""
    outputs: Sequence[Format] = ()
    made_of: Sequence[tuple[str, str]] = ()

    def __post_init__(self) -> None:
        scene = self.scene
        survey = self.survey
        MaterialTable.of(survey.materials, scene.surface_kinds, voxels=scene.has_voxels)
        # The cells of the cloud's precision that the scene spans have numbers of 32 bits.
        reach = float(np.abs(scene.bounds).max(initial=0.0))
        if survey.spray_g_m3:
            check_spray(scene.actors)
        for actor in scene.actors:
            actor.check(0.0, survey.duration_ns)
            ways, _ = actor.trajectory.poses(0, np.linspace(0, survey.duration_ns, 100))
            own = (actor.mesh.animation or actor.mesh).bounds
            reach = max(reach, float(np.abs(ways).max() + np.abs(own).max()))
        if reach / survey.precision_m >= 2**31 - 1:
            raise LidarError(
                f"precision_m {survey.precision_m} is too fine for a scene that reaches "
                f"{reach:.0f} m from its origin: use at least {reach / 2e9:.2g}."
            )
        warn_of_grey(scene, survey)

    @property
    def trials(self) -> int:
        """Number of planning trials."""
        return self.planning.trials if self.planning else 0

    @cached_property
    def sweeps(self) -> Sweeps:
        """Sweeps of the survey with poses and boxes of actors; seconds for thousands of poses."""
        return Sweeps.from_survey(self.survey, self.scene)


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
    LidarError
        If a file cannot be read, or fields do not fit together or the scene.
    """
    static = read_static_scene(scenario) if cache is None else cache.find(scenario)
    found = static.found.copy()
    scene = static.scene
    standing = static.standing
    shapes = Shapes(scenario, found)
    epsg = _common_epsg(scenario, found)
    way = scenario.trajectory
    with prefixed(scenario.source):
        track = None if way is None else way.track(scenario.path, standing)
        sensors = _mounted(shapes)
    placing: Placing | None = None
    if scenario.poses is None and track is None and not scenario.scene.has_seed:
        alone = scenario.mount is None and not scenario.sensors
        placing = place(
            scene,
            sensors[0],
            landscape=bool(found.rasters),
            buildings=found.named(BUILDING),
            narrow=alone and not scenario.sensor.model_fields_set,
        )
        if placing.grid:
            sensors = [replace(sensors[0], sensor=Sensor.grid(**placing.grid))]
    poses = SEED_POSES if placing is None else placing.poses
    survey_of = partial(_survey, scenario, found, sensors, track or poses, scene.origin, epsg)
    actors = _actors(shapes, standing, track)
    vehicles: list[tuple[Actor, VehicleSection]] = []
    if scenario.traffic is not None:
        with prefixed(scenario.source):
            duration_s = survey_of([]).duration_ns / 1e9
            start_s = 0.0 if track is None else track.start_s or 0.0
            vehicles = _vehicles(scenario.traffic, shapes, standing, start_s, duration_s)
    if actors or vehicles:
        scene = scene.with_actors([*scene.actors, *actors, *(actor for actor, _ in vehicles)])
    mistakes = Mistakes()
    planning = None
    with mistakes.noted():
        with prefixed(scenario.source):
            classes = [entry.semantic_class for _, entry in vehicles]
            survey = survey_of(_materials(scenario, found, scene, classes), columns)
        MaterialTable.of(survey.materials, scene.surface_kinds, voxels=scene.has_voxels)
    with mistakes.noted(), prefixed(scenario.source):
        planning = _planning(scenario, scene) if plans else None
    mistakes.tell()
    return Built(scenario, scene, survey, planning, placing, found)


@dataclass(frozen=True, eq=False)
class Built:
    """What a scenario describes; `build` makes it.

    Attributes
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

    def job(self, **own: Any) -> Job:
        """Return it as a job; `own` are further fields, such as `name`."""
        outputs = tuple(one for one in self.scenario.output.write if one.format != "ply")
        return Job(self.scene, self.survey, self.planning, outputs=outputs, **own)


def _common_epsg(scenario: Scenario, found: Findings) -> int | None:
    """EPSG code of the rasters that stay where they are; they must be of one system."""
    stay = [(e.file, raster) for e, raster in found.rasters if e.transform().keeps_xy]
    systems = {raster.crs: file for file, raster in stay if raster.crs}
    if len(systems) > 1:
        listed = ", ".join(f"{file} in {crs[:60]}" for crs, file in systems.items())
        raise LidarError(
            f"{scenario.source}: rasters of one scene have several coordinate systems: "
            f"{listed}. Give cloud.epsg, the code of the one that all of them are brought to."
        )
    return next((raster.epsg for _, raster in stay if raster.crs), None)


def _mounted(shapes: Shapes) -> list[Mounted]:
    """Return the sensors on their carrier."""
    scenario = shapes.scenario
    sections: Mapping[str, SensorSection] = scenario.sensors or {"": scenario.sensor}
    path = scenario.path
    noise = scenario.noise
    returns = scenario.returns
    return [
        section.mounted(path, _mount(section, shapes), noise, returns, name)
        for name, section in sections.items()
    ]


def _mount(section: SensorSection, shapes: Shapes) -> Pose:
    """Pose of a sensor in the carrier's axes."""
    scenario = shapes.scenario
    mount: MountSection | None = getattr(section, "mount", scenario.mount)
    if mount is None or mount.link is None:
        return CENTRE if mount is None else mount.pose()
    carriers = [
        (entry, shapes.robot(entry.robot))
        for entry in scenario.actors
        if entry.is_carrier and entry.robot
    ]
    on = [(entry, robot) for entry, robot in carriers if mount.link in robot.links]
    if len(on) != 1:
        links = [link for _, robot in carriers for link in robot.links]
        raise LidarError(
            f"mount.link is {mount.link!r}, which {len(on) or 'no'} robots on the carrier "
            f"have; one must.{did_you_mean(mount.link, links)}"
        )
    ((entry, robot),) = on
    with prefixed(f"actor {entry.name!r}"):
        path = robot.path(mount.link, **_joints(entry, scenario))
    if path.moves:
        file = None if entry.joints is None else entry.joints.file
        raise LidarError(
            f"mount.link is {mount.link!r}, which {file} moves, and a mount is rigid: "
            "mount the sensor on a link that does not move, or leave out those joints' columns."
        )
    return path.pose(0).then(mount.pose())


def _joints(entry: ActorSection, scenario: Scenario) -> dict[str, Any]:
    """Return the arguments of `Robot.path` and `Robot.actors` that are of a table of joints."""
    if entry.joints is None:
        return {}
    return {"joints": scenario.path(entry.joints.file), "ignore": entry.joints.ignore}


def _actors(shapes: Shapes, standing: Standing, track: Track | None) -> list[Actor]:
    """Build the actors; their trajectories begin with that of the survey."""
    scenario = shapes.scenario
    out = list[Actor]()
    with prefixed(scenario.source):
        ways = [e.way(scenario.path, standing, track) for e in scenario.actors]
    for entry, way in zip(scenario.actors, ways, strict=True):
        if entry.robot:
            with prefixed(f"{scenario.source}: actor {entry.name!r}"):
                out += _links(entry, shapes.robot(entry.robot), way, shapes)
        else:
            offset_s = 0.0 if entry.animation is None else entry.animation.offset_s
            mesh = replace(shapes.of(entry), name=entry.name)
            out.append(Actor(mesh, way, offset_s, entry.spray))
    return out


def _links(entry: ActorSection, robot: Robot, way: Track, shapes: Shapes) -> Sequence[Actor]:
    """Actors of a robot, without the links that sensors are mounted on."""
    tell = shapes.found.notes.append
    links = shapes.scenario.links
    without = links.intersection(robot.meshes) if entry.is_carrier else ()
    for link in sorted(without):
        tell(f"{entry.name}: link {link} is left out: a sensor is mounted on it")
    joints = _joints(entry, shapes.scenario)
    return robot.actors(way, name=entry.name, without=without, tell=tell, **joints)


def _vehicles(
    section: TrafficSection, shapes: Shapes, standing: Standing, start_s: float, duration_s: float
) -> list[tuple[Actor, VehicleSection]]:
    """Vehicles and persons that are there during the survey, each with its entry."""
    begin = start_s - section.offset_s
    found = shapes.found
    file = shapes.scenario.path(section.file)
    passages, count = read_fcd(file, begin, begin + duration_s, section.ignore)
    made = actors_of(section, passages, shapes.of, standing, start_s)
    if not made:
        found.notes.append(
            f"{section.file}: no vehicle or person is in the scene from {begin:g} to "
            f"{begin + duration_s:g} s of the file: check offset_s, translation and surfaces"
        )
    found.sources[section.file] = (
        f"{plural(len(made), 'actor')} during the survey, of {plural(count, 'vehicle')} "
        "and persons until its end"
    )
    return made


def _materials(
    scenario: Scenario, findings: Findings, scene: Scene, vehicles: Sequence[int | None]
) -> list[Material]:
    """Return materials by name, with the classes of actors, of copies and of objects of files.

    `vehicles` are the classes of the last actors of the scene.
    """
    default = Material("*")
    materials = [*scenario.materials]
    kinds = scene.surface_kinds
    classed: list[tuple[str, list[str], int]] = []  # an object, patterns of its names, its class
    for entry in scenario.placed:
        if entry.semantic_class is None:
            continue
        patterns = {entry.name: [escape(entry.name)]}
        numbered = f"{escape(entry.name)}.[0-9]*"
        if isinstance(entry, CopiesSection) and len(rows_named(numbered, scene.names)):
            patterns[entry.name].append(numbered)
        elif isinstance(entry, ActorSection) and entry.robot:
            links = [a.name for a in scene.actors if a.name.startswith(f"{entry.name}/")]
            patterns = {link: [escape(link)] for link in links}
        classed += [(name, names, entry.semantic_class) for name, names in patterns.items()]
    if classed and not materials:
        materials = [default]
    for name, names, semantic_class in classed:
        # Before the materials of the object: an earlier material, of a single copy, counts there.
        objects = np.concatenate([rows_named(pattern, kinds.names) for pattern in names])
        of_objects = {kinds.material[kind] for kind in kinds.of_rows(objects).tolist()}
        unclassed = materials
        materials = []
        for material in unclassed:
            if material.named(name, of_objects):
                with_class_of_object = replace(
                    material, objects=names, semantic_class=semantic_class
                )
                materials.append(with_class_of_object)
            materials.append(material)
        if not any(material.material is None and material.named(name) for material in unclassed):
            materials.append(replace(default, objects=names, semantic_class=semantic_class))
    first = len(scene.all_names) - len(vehicles)
    for semantic_class in sorted({number for number in vehicles if number is not None}):
        rows = np.array(
            [first + k for k, number in enumerate(vehicles) if number == semantic_class]
        )
        materials = with_class(materials or [default], semantic_class, rows, kinds)
    if findings.classes:
        class_patterns = {number: findings.named(number) for number in findings.class_names}
        materials = with_classes(materials or [default], class_patterns, kinds)
    return materials


def _survey(
    scenario: Scenario,
    findings: Findings,
    carried: Sequence[Mounted],
    carrier: Track | Sequence[Pose],
    origin: Floats,
    epsg: int | None,
    materials: Sequence[Material],
    columns: Sequence[str] = (),
) -> Survey:
    """Build the survey along a track, or at poses if the scenario gives none; local coordinates."""
    needs = scenario.output.needs
    cloud = declared(scenario.cloud, CloudOptions)
    cloud["columns"] = (*scenario.cloud.columns, *needs, *columns)
    cloud["epsg"] = scenario.cloud.epsg or epsg
    if scenario.scene.has_seed:
        cloud["keep_every"] = cloud["keep_every"] or (1 if "ray" in needs else SEED_KEPT)
    elif not any(mounted.sensor.optics.resolution_m for mounted in carried):
        cloud["precision_m"] = cloud["precision_m"] or MESH_PRECISION_M
    check_whole((*needs, *columns), cloud["keep_every"] or 1)
    track = carrier if isinstance(carrier, Track) else None
    poses = () if isinstance(carrier, Track) else scenario.poses or carrier
    # Files give classes to objects; a number or name in the scenario has the scenario's meaning.
    placed = (*scenario.placed, *(scenario.traffic.vehicles if scenario.traffic else ()))
    of_scenario = {entry.semantic_class for entry in (*scenario.materials, *placed)}
    has_classes = scenario.classes or "class" in cloud["columns"]
    of_files = {material.semantic_class for material in materials} - of_scenario
    numbers: dict[str, int] = {}  # {name of a class: number}
    if has_classes:
        numbers = {
            name: number for number, name in findings.class_names.items() if number in of_files
        }
    numbers |= {name: number for number, name in scenario.classes.items()}
    own_noise = all(mounted.noise is not None for mounted in carried)
    alone = not scenario.sensors and scenario.mount is None and carried[0].noise is None
    survey = Survey(
        poses=[replace(p, position=tuple(np.subtract(p.position, origin))) for p in poses],
        trajectory=track,
        **({"sensor": carried[0].sensor} if alone else {"sensors": carried}),
        steps=scenario.steps,
        materials=materials,
        classes={number: name for name, number in numbers.items()},
        returns=Returns(**dict(scenario.returns)),
        noise=Noise() if own_noise else Noise(**dict(scenario.noise)),
        navigation=scenario.navigation,
        faults=scenario.faults,
        **declared(scenario.weather, Weather),
        **cloud,
    )
    return with_laser_scans(survey, [entry.format for entry in scenario.output.write])


def _planning(scenario: Scenario, scene: Scene) -> Planning | None:
    """Build the planning in local coordinates; None if the scenario asks for none."""
    section, (x0, y0, _) = scenario.planning, scene.origin
    start = section.start
    target = section.target
    if scenario.scene.has_seed:
        start = start or SEED_START
        target = target or SEED_TARGET
    if section.enabled is False or start is None or target is None:
        return None
    discs, labels = _discs(scenario, scene)
    discs[:, 2] += section.clearance_m
    wide = np.flatnonzero(discs[:, 2])  # upright lines have no area
    discs = discs[wide]
    labels = [labels[i] for i in wide]
    begin, last = [(x - x0, y - y0) for x, y in (start, target)]
    for end, point in (("start", begin), ("target", last)):
        inside = np.hypot(*(discs[:, :2] - point).T) < discs[:, 2]
        if inside.any():
            first = int(inside.argmax())
            raise LidarError(
                f"planning.{end} lies {discs[first, 2]:.2f} m or less from the middle of "
                f"{labels[first]}, within its circle: move it, or list other "
                "planning.obstacles."
            )
    own = declared(section, Search)
    return Planning(begin, last, centres=discs[:, :2], radii=discs[:, 2], **own)


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
            raise LidarError(
                f"planning.obstacles names {entry.object!r}, but no object has that name."
                + (hint or f" The scene has {', '.join(scene.names[:5])}, …")
            )
        rows |= {scene.names[i]: list(scene.footprints[i]) for i in found}
    return np.array(list(rows.values()), dtype=np.float64).reshape(-1, 3), list(rows)
