"""Convert scenarios to jobs.

Preparing a scenario means reading its files, and creating a job with its scene, survey and
planning.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from glob import escape
from typing import Any, NamedTuple

import numpy as np

from lidarfiles.clouds.format_table import check_all_returns
from lidarfiles.clouds.writing import with_format_columns
from lidarscenes.robots.robot import Robot
from lidarsim.errors import LidarError, Mistakes, prefix_errors
from lidarsim.media.materials import (
    Material,
    SurfaceKinds,
    assign_class,
    assign_classes,
    match_names,
)
from lidarsim.media.weather import Weather
from lidarsim.motion.trajectory import CENTER, Pose, Track
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.actors import Actor
from lidarsim.scene.files.coordinate_systems import describe_heights, same_vertical_datum
from lidarsim.scene.scene import Scene
from lidarsim.schema.declared import declared_values
from lidarsim.sensor import Noise, Returns, Sensor
from lidarsim.simulator.recorded_sweeps import scene_of_bodies
from lidarsim.survey.survey import CloudOptions, Mounted, Survey
from lidarsim.words import name_hint, plural

from .default_poses import SensorPlacement, place_sensor
from .georeference import check_epsg
from .job import Job
from .plan import Planning
from .plan.planning import Search
from .scenario import Scenario
from .sections import CopiesSection, SensorSection
from .static_scene import FileFindings, SceneCache, ShapeLoader, StaticScene, read_static_scene
from .traffic.actor_motion import ActorSection, MountSection
from .traffic.ground import SupportSurfaces
from .traffic.osi_trace import OSI_SUFFIXES
from .traffic.osi_traffic import read_osi
from .traffic.traffic import (
    TrafficContent,
    TrafficSection,
    TravelerFilter,
    VehicleSection,
    build_traffic_actors,
    platform_track,
    read_fcd,
)

_log = logging.getLogger(__name__)

# Objects below this height, such as floors and markings, are not obstacles.
FLAT_M = 0.2

# Default poses of the sensor in the scene of the demo, in world coordinates.
SEED_POSES = tuple(Pose((0.0, 0.0, height)) for height in (1.0, 2.0, 3.0))

# ASPRS LAS classes that affect default poses.
BUILDING = 6
ROAD_SURFACE = 11

# Default precision of points if no sensor specifies a resolution.
MESH_PRECISION_M = 0.001


@dataclass(frozen=True, eq=False)
class PreparedScenario:
    """Scenario whose files have been read and validated.

    Attributes
    ----------
    scenario
        The scenario.
    job
        Scene, survey and planning of the scenario. `world.origin` has been added to the scene.
    placement
        Default poses that `place_sensor` chose. It is None if the scenario defines poses or a
        trajectory, or contains the objects of the demo.
    findings
        Notes about the files, and descriptions of their content.
    """

    scenario: Scenario
    job: Job
    placement: SensorPlacement | None
    findings: FileFindings

    @property
    def scene(self) -> Scene:
        """Scene of the job."""
        return self.job.scene

    @property
    def survey(self) -> Survey:
        """Survey of the job."""
        return self.job.survey


def prepare(
    scenario: Scenario,
    *,
    plans: bool = True,
    cache: SceneCache | None = None,
    columns: Sequence[str] = (),
    **fields: Any,
) -> PreparedScenario:
    """Read the files of a scenario, and create a job from its scene, survey and planning.

    Parameters
    ----------
    scenario
        The scenario.
    plans
        Whether the job includes the planning of the scenario.
    cache
        Cache of static scenes that this scenario may share with other scenarios.
    columns
        Names of columns to add to the cloud.
    **fields
        Additional fields of the job, such as `name`.

    Raises
    ------
    LidarError
        If a file cannot be read, or if fields contradict each other or the scene.
    """
    with scenario.explain_missing_files():
        _check_sensors(scenario)
        static = read_static_scene(scenario) if cache is None else cache.get_scene(scenario)
        return _prepare(scenario, static, plans, columns, fields)


def _prepare(
    scenario: Scenario,
    static: StaticScene,
    plans: bool,
    columns: Sequence[str],
    fields: Mapping[str, Any],
) -> PreparedScenario:
    """Prepare a scenario whose static scene has been read."""
    findings = static.findings.copy()
    shapes = ShapeLoader(scenario, findings)
    survey_parts = _survey_parts(shapes, static)
    track_or_poses = survey_parts.track_or_poses
    track = track_or_poses if isinstance(track_or_poses, Track) else None
    actors = _build_actors(shapes, static.support, track)
    vehicles = _build_traffic(survey_parts, shapes, static.support)
    scene = static.scene
    if actors or vehicles:
        scene = scene.with_actors([*scene.actors, *actors, *(actor for actor, _ in vehicles)])
    mistakes = Mistakes()
    planning = None
    if plans:
        with mistakes.collect(), prefix_errors(scenario.source):
            planning = _build_planning(scenario, scene)
    with mistakes.collect(), prefix_errors(scenario.source):
        materials = _materials(scenario, findings, scene, vehicles)
        job = Job(
            scene=scene.with_world_origin(scenario.world.origin),
            survey=_build_survey(survey_parts, materials, columns),
            planning=planning,
            # PLY files are always written.
            outputs=tuple(entry for entry in scenario.output.write if entry.format != "ply"),
            **fields,
        )
    mistakes.raise_if_any()
    return PreparedScenario(scenario, job, survey_parts.placement, findings)


class PreparedActors(NamedTuple):
    """Actors of a scenario without a static scene.

    Attributes
    ----------
    actors
        Actors and traffic. Coordinates are those of the scenario, and times start at 0 s.
    materials
        Materials of the scenario, with entries for the classes of the actors.
    classes
        Names of semantic classes by number.
    notes
        Notes about the files of the actors.
    """

    actors: Sequence[Actor]
    materials: Sequence[Material]
    classes: Mapping[int, str]
    notes: Sequence[str]


def prepare_actors(scenario: Scenario, duration_s: float = np.inf) -> PreparedActors:
    """Read the files of a scenario that has actors or traffic, but no static scene.

    Parameters
    ----------
    scenario
        The scenario. Its actors must not follow surfaces.
    duration_s
        Duration in seconds of the traffic that is read.

    Raises
    ------
    LidarError
        If a file cannot be read.
    """
    findings = FileFindings()
    shapes = ShapeLoader(scenario, findings)
    support = SupportSurfaces(None)
    vehicles: list[tuple[Actor, VehicleSection]] = []
    with scenario.explain_missing_files():
        actors = _build_actors(shapes, support, None)
        if scenario.traffic is not None:
            with prefix_errors(scenario.source):
                vehicles = _traffic_actors(scenario.traffic, shapes, support, 0.0, duration_s)
        actors += [actor for actor, _ in vehicles]
        materials: Sequence[Material] = scenario.materials
        if actors:
            with prefix_errors(scenario.source):
                scene = scene_of_bodies(actors=tuple(actors))
                materials = _materials(scenario, findings, scene, vehicles)
    classes = _class_names(scenario, findings, materials, ())
    return PreparedActors(actors, materials, classes, [*findings.notes, *findings.remarks])


class _SurveyParts(NamedTuple):
    """Parts of a survey that do not depend on materials."""

    scenario: Scenario
    findings: FileFindings
    sensors: Sequence[Mounted]
    # Trajectory of the platform in local coordinates, or poses in world coordinates. Default poses
    # are used if the scenario defines neither.
    track_or_poses: Track | Sequence[Pose]
    origin: Floats  # (3,), scene origin in world coordinates, meters
    epsg: int | None  # EPSG code that the files of the scene state
    placement: SensorPlacement | None  # default poses, if they are used


def _survey_parts(shapes: ShapeLoader, static: StaticScene) -> _SurveyParts:
    """Return the sensors of a scenario, with their trajectory or poses."""
    scenario = shapes.scenario
    scene = static.scene
    findings = shapes.findings
    epsg = _common_epsg(scenario, findings)
    _check_heights(scenario, findings)
    with prefix_errors(scenario.source):
        if scenario.world.epsg is not None:  # fail before files of moving objects are read
            check_epsg(scenario.world.epsg, scene.with_world_origin(scenario.world.origin))
        track = _platform_track(shapes, static.support)
        sensors = _mounted_sensors(shapes)
    placement: SensorPlacement | None = None
    if scenario.poses is None and track is None and not scenario.scene.has_seed:
        placement = _place_sensor(scenario, scene, findings, sensors[0])
        if placement.grid:  # no sensor is set, and the scene is a single object
            sensors = [replace(sensors[0], sensor=Sensor.grid(**placement.grid))]
    track_or_poses = track or scenario.poses or (placement.poses if placement else SEED_POSES)
    return _SurveyParts(scenario, findings, sensors, track_or_poses, scene.origin, epsg, placement)


def _platform_track(shapes: ShapeLoader, support: SupportSurfaces) -> Track | None:
    """Return the platform's trajectory in local coordinates, or None if it has none."""
    scenario = shapes.scenario
    entry = scenario.trajectory
    if entry is None:
        return None
    if entry.vehicle is None:
        return entry.track(
            scenario.path,
            support,
            name="the platform",
            without_angles=shapes.findings.without_angles,
        )
    section = scenario.traffic
    assert section is not None, "guaranteed by the validation of the scenario"
    content = _read_traffic(scenario, -np.inf, np.inf, TravelerFilter(only=entry.vehicle))
    return platform_track(entry, section, content, shapes.load_mesh, support)


def _read_traffic(
    scenario: Scenario, first_s: float, last_s: float, travelers: TravelerFilter
) -> TrafficContent:
    """Read the traffic between two times. They refer to the clock of the traffic file."""
    section = scenario.traffic
    assert section is not None
    file = scenario.path(section.file)
    if file.name.lower().endswith(OSI_SUFFIXES):
        return read_osi(file, section, first_s, last_s, travelers)
    return read_fcd(file, section, first_s, last_s, travelers)


def _place_sensor(
    scenario: Scenario, scene: Scene, findings: FileFindings, sensor: Mounted
) -> SensorPlacement:
    """Choose poses for a scenario that specifies neither poses nor a trajectory.

    Scenes with rasters or road networks are landscapes. If the scenario does not specify the
    sensor, and the scene is a single object, the sensor is a grid that is as wide as the object.
    """
    is_unmounted = scenario.mount is None and not scenario.sensors
    return place_sensor(
        scene,
        sensor,
        landscape=bool(findings.landscapes),
        buildings=findings.class_patterns(BUILDING),
        roads=findings.class_patterns(ROAD_SURFACE),
        narrow=is_unmounted and scenario.sensor.model_fields_set <= {"unseen"},
    )


def _build_traffic(
    survey_parts: _SurveyParts, shapes: ShapeLoader, support: SupportSurfaces
) -> list[tuple[Actor, VehicleSection]]:
    """Create the actors of the traffic during the survey.

    Each actor is returned with the entry that defines its shape. The list is empty if the scenario
    has no traffic.
    """
    scenario = survey_parts.scenario
    if scenario.traffic is None:
        return []
    with prefix_errors(scenario.source):
        # The duration does not depend on the materials.
        duration_s = _build_survey(survey_parts, []).duration_ns / 1e9
        track_or_poses = survey_parts.track_or_poses
        # The start of the survey refers to the clock of the platform's trajectory.
        start_s = track_or_poses.start_s or 0.0 if isinstance(track_or_poses, Track) else 0.0
        return _traffic_actors(scenario.traffic, shapes, support, start_s, duration_s)


def _common_epsg(scenario: Scenario, findings: FileFindings) -> int | None:
    """Return the EPSG code that the files of a scene state, or None.

    Return None if `world.epsg` is set. In this case, add a note for each file that states a
    different system and is not transformed. Raise LidarError if the files have different coordinate
    systems, or if `world.origin` would move them.
    """
    systems = {system.crs: system for system in findings.systems if system.crs}
    x, y, _ = scenario.world.origin
    if systems and (x or y):
        first = next(iter(systems.values()))
        raise LidarError(
            f"{scenario.source}: `world.origin` would also be added to {first.file}, whose "
            f"coordinates are already in {first.crs[:60]}. Set `translation: "
            f"[{-x:.12g}, {-y:.12g}, 0]` for the file, or remove `world.origin`."
        )
    if scenario.world.epsg is not None:
        world = f"EPSG:{scenario.world.epsg}"
        findings.notes += [
            f"{system.file} is in {crs}, but the output states {world}, because `world.epsg` is "
            "set. If the file is correct, remove `world.epsg`"
            for crs, system in systems.items()
            if crs != world and not system.is_raster
        ]
        return None
    if len(systems) > 1:
        listed = ", ".join(f"{system.file} in {crs[:60]}" for crs, system in systems.items())
        raise LidarError(
            f"{scenario.source}: The files of the scene have different coordinate systems "
            f"({listed}). Set `world.epsg` to the EPSG code of one system. Rasters are reprojected "
            "to it, but you must convert all other files."
        )
    return next((system.epsg for system in systems.values()), None)


def _check_heights(scenario: Scenario, findings: FileFindings) -> None:
    """Raise LidarError if the files of a scene have heights in different vertical datums.

    If only some files with a coordinate system state a vertical datum, add a note.
    """
    systems = [system for system in findings.systems if system.vertical_datum is not None]
    first = next((system for system in systems if system.vertical_datum), None)
    if first is None:
        return
    datum = str(first.vertical_datum)
    for system in systems:
        other = str(system.vertical_datum)
        if not other:
            findings.notes.append(
                f"{system.file} does not state a vertical datum. Its heights are assumed to be "
                f"{describe_heights(datum)}, as in {first.file}"
            )
        elif not same_vertical_datum(datum, other):
            raise LidarError(
                f"{scenario.source}: {first.file} has {describe_heights(datum)}, but {system.file} "
                f"has {describe_heights(other)}. Transform one of them first, for example with "
                "gdalwarp or PDAL and a geoid grid, or set `translation: [0, 0, Z]` for one of the "
                "files if the difference is constant."
            )


def _check_sensors(scenario: Scenario) -> None:
    """Raise LidarError if the model or calibration of a sensor cannot be read.

    This is checked before the scene is read, which may take minutes. Sensors are cached, so they
    are not read again.
    """
    sections: Mapping[str, SensorSection] = scenario.sensors or {"": scenario.sensor}
    with prefix_errors(scenario.source):
        for name, section in sections.items():
            section.mounted_sensor(scenario.path, CENTER, scenario.noise, scenario.returns, name)


def _mounted_sensors(shapes: ShapeLoader) -> list[Mounted]:
    scenario = shapes.scenario
    sections: Mapping[str, SensorSection] = scenario.sensors or {"": scenario.sensor}
    path = scenario.path
    noise = scenario.noise
    returns = scenario.returns
    return [
        section.mounted_sensor(path, _mount_pose(section, shapes), noise, returns, name)
        for name, section in sections.items()
    ]


def _mount_pose(section: SensorSection, shapes: ShapeLoader) -> Pose:
    """Return the pose of a sensor in the platform frame.

    If the mount has a link, its pose is relative to that link of a robot on the platform. Raise
    LidarError if the link is not a link of exactly one robot, or if joints move it.
    """
    scenario = shapes.scenario
    mount: MountSection | None = getattr(section, "mount", scenario.mount)
    if mount is None or mount.link is None:
        return CENTER if mount is None else mount.pose()
    robots = [
        (entry, shapes.load_robot(entry.robot))
        for entry in scenario.actors
        if entry.is_platform and entry.robot
    ]
    matching_robots = [(entry, robot) for entry, robot in robots if mount.link in robot.links]
    if len(matching_robots) != 1:
        links = [link for _, robot in robots for link in robot.links]
        raise LidarError(
            "`mount.link` must be a link of exactly one robot on the platform, but "
            f"{plural(len(matching_robots), 'robot has', 'robots have')} a link "
            f"{mount.link!r}.{name_hint(mount.link, links)}"
        )
    ((entry, robot),) = matching_robots
    with prefix_errors(f"actor {entry.name!r}"):
        path = robot.path(mount.link, **_joint_arguments(entry, scenario))
    if path.moves:
        file = None if entry.joints is None else entry.joints.file
        raise LidarError(
            f"`mount.link` is {mount.link!r}, which is moved by {file}, but a mount must be rigid. "
            "Mount the sensor on a link that does not move, or remove the columns of these joints."
        )
    return path.pose(0).compose(mount.pose())


def _joint_arguments(entry: ActorSection, scenario: Scenario) -> dict[str, Any]:
    """Return the joint table of an entry as arguments of `Robot.path` and `Robot.actors`."""
    if entry.joints is None:
        return {}
    return {
        "joints": scenario.path(entry.joints.file),
        "ignore": entry.joints.ignore,
        "time_unit": entry.joints.time_unit,
    }


def _build_actors(
    shapes: ShapeLoader, support: SupportSurfaces, track: Track | None
) -> list[Actor]:
    """Create the actors of a scenario, excluding traffic.

    `track` is the trajectory of the platform, or None. It is also the trajectory of actors that
    have neither a trajectory nor a pose. All trajectories start at the start of the survey.
    """
    scenario = shapes.scenario
    actors = list[Actor]()
    with prefix_errors(scenario.source):
        without_angles = shapes.findings.without_angles
        trajectories = [
            entry.track(scenario.path, support, track, without_angles) for entry in scenario.actors
        ]
    for entry, trajectory in zip(scenario.actors, trajectories, strict=True):
        if entry.robot:
            with prefix_errors(f"{scenario.source}: actor {entry.name!r}"):
                actors += _robot_actors(entry, shapes.load_robot(entry.robot), trajectory, shapes)
        else:
            offset_s = 0.0 if entry.animation is None else entry.animation.offset_s
            mesh = replace(shapes.load_mesh(entry), name=entry.name)
            actors.append(Actor(mesh, trajectory, offset_s, entry.spray))
    return actors


def _robot_actors(
    entry: ActorSection, robot: Robot, trajectory: Track, shapes: ShapeLoader
) -> Sequence[Actor]:
    """Return the actors of a robot, one for each link.

    If the robot is on the platform, links on which sensors are mounted are omitted.
    """
    add_note = shapes.findings.notes.append
    links = shapes.scenario.mount_links
    sensor_links = links.intersection(robot.meshes) if entry.is_platform else ()
    for link in sorted(sensor_links):
        add_note(
            f"link {link} of {entry.name} is not part of the scene, because a sensor is mounted "
            "on it"
        )
    joints = _joint_arguments(entry, shapes.scenario)
    return robot.actors(
        trajectory, name=entry.name, without=sensor_links, report=add_note, **joints
    )


def _traffic_actors(
    section: TrafficSection,
    shapes: ShapeLoader,
    support: SupportSurfaces,
    start_s: float,
    duration_s: float,
) -> list[tuple[Actor, VehicleSection]]:
    """Return the actors of the traffic during the survey, with their scenario entries.

    `start_s` and `duration_s` are the start and duration of the survey in seconds. The start refers
    to the clock of the platform's trajectory.
    """
    file_start_s = start_s - section.offset_s
    findings = shapes.findings
    scenario = shapes.scenario
    file_stop_s = file_start_s + duration_s
    platform = None if scenario.trajectory is None else scenario.trajectory.vehicle
    travelers = TravelerFilter(without=platform)
    content = _read_traffic(scenario, file_start_s, file_stop_s, travelers)
    findings.notes += content.notes
    actors = build_traffic_actors(section, content.passages, shapes.load_mesh, support, start_s)
    if not actors:
        findings.notes.append(
            f"{section.file} has no vehicle or person in the scene from {file_start_s:g} to "
            f"{file_stop_s:g} s. Check `offset_s`, `translation` and `surfaces`"
        )
    findings.sources[section.file] = (
        f"{plural(len(actors), 'actor')} during the survey, out of {content.counted} until its end"
    )
    return actors


def _materials(
    scenario: Scenario,
    findings: FileFindings,
    scene: Scene,
    vehicles: Sequence[tuple[Actor, VehicleSection]],
) -> list[Material]:
    """Return the materials of a scenario, including entries for the classes of objects.

    The classes of actors, copies and traffic are set in the scenario, and the classes of other
    objects are read from files. `vehicles` contains the last actors of the scene, with their
    entries in `traffic.vehicles`.
    """
    vehicle_classes = [entry.semantic_class for _, entry in vehicles]
    default_material = Material("*")
    materials = [*scenario.materials]
    kinds = scene.surface_kinds
    classed = _classed_objects(scenario, scene)
    if classed and not materials:
        materials = [default_material]
    for classed_object in classed:
        materials = _with_object_class(materials, classed_object, kinds)
    first_vehicle_row = len(scene.object_names) - len(vehicles)  # index into `scene.object_names`
    for semantic_class in sorted({number for number in vehicle_classes if number is not None}):
        vehicle_rows = np.array(
            [
                first_vehicle_row + k
                for k, number in enumerate(vehicle_classes)
                if number == semantic_class
            ]
        )
        materials = assign_class(
            materials or [default_material], semantic_class, vehicle_rows, kinds
        )
    if findings.classes:
        class_patterns = {
            number: findings.class_patterns(number) for number in findings.class_names
        }
        materials = assign_classes(materials or [default_material], class_patterns, kinds)
    return materials


class _ClassedObject(NamedTuple):
    """Object to which an entry of `scene.copies` or `actors` assigns a class."""

    name: str  # name of the entry or the robot link
    patterns: list[str]  # match the names of the object and its numbered copies in the scene
    semantic_class: int


def _classed_objects(scenario: Scenario, scene: Scene) -> list[_ClassedObject]:
    """Return the objects to which entries of `scene.copies` or `actors` assign a class.

    All copies of an entry are treated as one object, and each link of a robot as a separate object.
    """
    classed: list[_ClassedObject] = []
    for entry in scenario.object_entries:
        if entry.semantic_class is None:
            continue
        patterns = {entry.name: [escape(entry.name)]}
        numbered = f"{escape(entry.name)}.[0-9]*"  # all copies except the first, such as Tree.2
        if isinstance(entry, CopiesSection) and len(match_names(numbered, scene.names)):
            patterns[entry.name].append(numbered)
        elif isinstance(entry, ActorSection) and entry.robot:
            links = [a.name for a in scene.actors if a.name.startswith(f"{entry.name}/")]
            patterns = {link: [escape(link)] for link in links}
        classed += [
            _ClassedObject(name, names, entry.semantic_class) for name, names in patterns.items()
        ]
    return classed


def _with_object_class(
    materials: Sequence[Material], classed: _ClassedObject, kinds: SurfaceKinds
) -> list[Material]:
    """Return materials that assign a class to an object.

    Before each entry that applies to the object, an entry with the same properties and the class is
    inserted, which only applies to the object.
    """
    object_rows = np.concatenate(
        [match_names(pattern, kinds.names) for pattern in classed.patterns]
    )
    object_materials = {
        kinds.material[kind] for kind in kinds.kinds_of_objects(object_rows).tolist()
    }
    changes: dict[str, Any] = {
        "objects": classed.patterns,
        "semantic_class": classed.semantic_class,
    }
    result: list[Material] = []
    for material in materials:
        # The first matching entry applies to a face. An entry for a single copy, such as Tree.7,
        # does not match the name of the object. It stays before the new entry and still applies.
        if material.applies_to(classed.name, object_materials):
            result.append(replace(material, **changes))
        result.append(material)
    if not any(entry.material is None and entry.applies_to(classed.name) for entry in materials):
        result.append(replace(Material("*"), **changes))
    return result


def _build_survey(
    survey_parts: _SurveyParts, materials: Sequence[Material], columns: Sequence[str] = ()
) -> Survey:
    """Create the survey in local coordinates, with a trajectory or poses.

    `columns` contains the names of columns to add to the cloud, besides those that the scenario and
    the formats require. The class is only added if a material has a class.
    """
    scenario = survey_parts.scenario
    sensors = survey_parts.sensors
    format_columns = scenario.output.needs
    cloud = declared_values(scenario.cloud, CloudOptions)
    if not any(material.semantic_class for material in materials):
        columns = [name for name in columns if name != "class"]
    cloud["columns"] = (*scenario.cloud.columns, *format_columns, *columns)
    if not any(mounted.sensor.optics.resolution_m for mounted in sensors):
        cloud["precision_m"] = cloud["precision_m"] or MESH_PRECISION_M
    check_all_returns((*format_columns, *columns), cloud["keep_every"] or 1)
    track_or_poses = survey_parts.track_or_poses
    track = track_or_poses if isinstance(track_or_poses, Track) else None
    poses = () if isinstance(track_or_poses, Track) else track_or_poses
    all_have_noise = all(mounted.noise is not None for mounted in sensors)
    is_mounted = scenario.sensors or scenario.mount is not None or scenario.sensor.unseen
    is_plain_sensor = not is_mounted and sensors[0].noise is None
    survey = Survey(
        poses=[
            replace(p, position=tuple(np.subtract(p.position, survey_parts.origin))) for p in poses
        ],
        trajectory=track,
        **({"sensor": sensors[0].sensor} if is_plain_sensor else {"sensors": sensors}),
        steps=scenario.steps,
        materials=materials,
        classes=_class_names(scenario, survey_parts.findings, materials, cloud["columns"]),
        returns=Returns(**dict(scenario.returns)),
        noise=Noise() if all_have_noise else Noise(**dict(scenario.noise)),
        navigation=scenario.navigation,
        faults=scenario.faults,
        epsg=scenario.world.epsg or survey_parts.epsg,
        **declared_values(scenario.weather, Weather),
        **cloud,
    )
    return with_format_columns(survey, scenario.output.write)


def _class_names(
    scenario: Scenario,
    findings: FileFindings,
    materials: Sequence[Material],
    columns: Sequence[str],
) -> dict[int, str]:
    """Return the names of a survey's classes, keyed by class number.

    The names are taken from `scenario.classes`, and from the classes that files assign to objects,
    unless the scenario uses the number or the name for a different class. `columns` are the columns
    of the cloud, besides those that the formats store if there are classes.
    """
    entries = (*scenario.object_entries, *(scenario.traffic.vehicles if scenario.traffic else ()))
    scenario_classes = {entry.semantic_class for entry in (*scenario.materials, *entries)}
    file_classes = {material.semantic_class for material in materials} - scenario_classes
    numbers: dict[str, int] = {}  # {class name: number}
    format_columns = {name for spec in scenario.output.write for name in spec.added}
    if scenario.classes or "class" in (*columns, *format_columns):
        numbers = {
            name: number for number, name in findings.class_names.items() if number in file_classes
        }
    numbers |= {name: number for number, name in scenario.classes.items()}
    return {number: name for name, number in numbers.items()}


def _build_planning(scenario: Scenario, scene: Scene) -> Planning | None:
    """Create the planning problem in local coordinates, or return None if no path is planned.

    Raise LidarError if the start or target is inside an obstacle.
    """
    section = scenario.planning
    x0, y0, _ = scene.origin
    start = section.start
    target = section.target
    if section.enabled is False or start is None or target is None:
        return None
    discs, labels = _obstacle_discs(scenario, scene)
    discs[:, 2] += section.clearance_m
    with_area = np.flatnonzero(discs[:, 2])  # objects that are vertical lines have no area
    discs = discs[with_area]
    labels = [labels[i] for i in with_area]
    start_xy, target_xy = [(x - x0, y - y0) for x, y in (start, target)]
    for end, point in (("start", start_xy), ("target", target_xy)):
        inside = np.hypot(*(discs[:, :2] - point).T) < discs[:, 2]
        if inside.any():
            first = int(inside.argmax())
            raise LidarError(
                f"`planning.{end}` must be outside all obstacles, but is within "
                f"{discs[first, 2]:.2f} m of the center of {labels[first]}. Move it, or change "
                "`planning.obstacles`."
            )
    search_options = declared_values(section, Search)
    return Planning(start_xy, target_xy, centers=discs[:, :2], radii=discs[:, 2], **search_options)


def _obstacle_discs(scenario: Scenario, scene: Scene) -> tuple[Floats, list[str]]:
    """Return the obstacles as discs, with a label for each disc.

    Each row of the discs contains x, y and radius in local coordinates, in meters. The shape is
    (m, 3). By default, all static objects that are at least `FLAT_M` high are obstacles. The radii
    do not include `planning.clearance_m`.
    """
    if scenario.planning.obstacles is None:
        tall = np.flatnonzero(np.ptp(scene.object_bounds[..., 2], axis=1) >= FLAT_M)
        return scene.footprints[tall], [scene.names[i] for i in tall]
    discs: dict[str, list[float]] = {}  # {label: x, y, radius}
    for number, entry in enumerate(scenario.planning.obstacles):
        if entry.object is None:
            assert entry.center and entry.radius_m, "guaranteed by the validation of the obstacle"
            center = np.subtract(entry.center, scene.origin[:2])
            discs[f"planning.obstacles[{number}]"] = [*center, entry.radius_m]
            continue
        # Exact names, which may contain brackets, take precedence over patterns.
        matches = [i for i, name in enumerate(scene.names) if name == entry.object] or [
            i for i, name in enumerate(scene.names) if fnmatchcase(name, entry.object)
        ]
        if not matches:
            raise LidarError(
                f"`planning.obstacles` contains {entry.object!r}, but no object has that name."
                f"{name_hint(entry.object, scene.names)}"
            )
        discs |= {scene.names[i]: list(scene.footprints[i]) for i in matches}
    return np.array(list(discs.values()), dtype=np.float64).reshape(-1, 3), list(discs)
