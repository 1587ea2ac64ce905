"""The data of a result's pictures, except the cloud, in a separate file."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lidarpool.plan import Plan, Planning
from lidarpool.run.run_result import RunResult
from lidarpool.scenario.build import Job
from lidarsim.base.archives import open_archive, packed
from lidarsim.base.arrays import AnyArray, Floats, Floats32
from lidarsim.base.words import plural
from lidarsim.columns.table import CAUSES, TABLE, Column, by_value
from lidarsim.scene.actors import Actor, samples_each, shapes_of
from lidarsim.scene.animation import Animation
from lidarsim.scene.colours import Colours
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.scene.simplified import Drawn, cut
from lidarsim.sensor import Survey, Track
from lidarsim.sensor.materials import MaterialTable
from lidarsim.sensor.trajectory import ALWAYS, Beyond, presence_ns

PICTURE_FILE = "pictures.npz"

MODELS_MOST = 4  # sensors named in a picture
PLACES_MOST = 1000  # positions of a moving sensor or actor
_FORMAT = 6
# {name in the file: field of an actor's track}
_TRACK = {"times": "times_s", "positions": "positions", "quaternions": "quaternions"}
_PLAN_NUMBERS = ("length", "shortest_possible", "clearance", "trial", "trials")


@dataclass(frozen=True, eq=False)
class SensorWay:
    """Positions of a sensor over time."""

    times_ns: Floats  # (k,), ascending, nanoseconds since the survey's start
    positions: Floats  # (k, 3), metres, local coordinates
    moves: bool = False  # from each position to the next; else it stands until the next time
    name: str = ""  # "" for a single sensor
    model: str = ""

    def at(self, time_ns: float) -> Floats:
        """Its position at a time, (3,)."""
        if self.moves:
            return np.array([np.interp(time_ns, self.times_ns, x) for x in self.positions.T])
        last = int(np.searchsorted(self.times_ns, time_ns, "right")) - 1
        return np.asarray(self.positions[max(last, 0)])


@dataclass(frozen=True, eq=False)
class PictureContent:
    """Content of a result's pictures, except the points."""

    scene: Scene  # its actors have a thousand places at most, and poses for pictures
    sensors: Sequence[SensorWay]
    hit_counts: AnyArray  # (f,): of each triangle, those of actors after the others
    sample_rays: Floats32  # (k, 2, 3): ends of some rays, metres, local coordinates
    planning: Planning | None
    plan: Plan | None
    # (w, 2) each: corners of the paths of all trials between the two ends, metres.
    trials: Sequence[Floats]
    duration_ns: float = 0.0  # of the survey, by its own clock
    own: Sequence[Column] = ()  # columns of the cloud's file that are not in the table of columns
    # (objects,): share of light that each reflects, actors after the others; None if unknown.
    reflectance: Floats | None = None
    coordinates: str = "world"  # of the cloud's points, or "sensor": they do not fit the scene
    triangles: int = 0  # of the scene, though simpler instances may be drawn
    classes: Sequence[str] | None = None  # names of the classes 0, 1, 2, …
    materials: Sequence[str] | None = None  # names of the materials 0, 1, 2, …

    @classmethod
    def of(cls, result: RunResult) -> PictureContent:
        """Return what the pictures of a result show."""
        pictured, drawn = cls.before(result)
        return replace(
            pictured,
            hit_counts=drawn.hits(result.hit_counts),
            sample_rays=result.sample_rays,
            plan=result.plan,
            trials=[trial.waypoints for trial in result.trials],
        )

    @classmethod
    def before(cls, job: Job | RunResult) -> tuple[PictureContent, Drawn]:
        """Return what is pictured before there is a result, and which counters its hits have."""
        scene, survey = job.scene, job.survey
        each = samples_each(scene.actors, PLACES_MOST)
        actors = tuple(_sampled(actor, survey.duration_ns, each) for actor in scene.actors)
        ways = sensor_ways(survey)
        drawn = Drawn.of(cut(scene), near=[way.positions for way in ways])
        light = survey.carried[0].sensor.optics.wavelength_nm  # of the first sensor
        kinds = scene.surface_kinds
        materials = MaterialTable.of(survey.materials, kinds, light, scene.has_voxels)
        pictured = cls(
            replace(drawn.scene, actors=actors),
            ways,
            np.zeros(0, np.int64),
            np.zeros((0, 2, 3), np.float32),
            job.planning,
            None,
            (),
            survey.duration_ns,
            [replace(c, source="") for c in survey.stored_columns if c.name not in TABLE],
            materials.reflectance[kinds.first[:-1]],
            survey.coordinates,
            scene.triangles,
            by_value(survey.classes),
            scene.material_names,
        )
        return pictured, drawn

    @property
    def when(self) -> str:
        """Describe the sensors, and the time of pictures with motion: half of the survey."""
        sensors, actors = len(self.sensors), len(self.scene.actors)
        if any(way.moves for way in self.sensors):
            words = f"{plural(sensors, 'sensor')} on {'its' if sensors == 1 else 'their'} way"
        else:
            words = plural(sum(len(w.positions) for w in self.sensors), "sensor position")
            if not actors:
                return words
        words += f" and {plural(actors, 'actor')}" if actors else ""
        return f"{words}, at {self.duration_ns / 2e9:.3g} s of {self.duration_ns / 1e9:.3g} s"

    @property
    def models(self) -> str:
        """Models of the sensors, with their names if they have any."""
        words = [f"{way.name}: {way.model}" if way.name else way.model for way in self.sensors]
        more = len(words) - MODELS_MOST
        return " · ".join(words[:MODELS_MOST]) + (f" · and {more:,} more" if more > 0 else "")

    def names_of(self, column: Column) -> Sequence[str]:
        """Names of the values 0, 1, 2, … of a column, if any."""
        if column.name == "sensor":
            return [way.name for way in self.sensors]
        if column == TABLE["cause"]:
            return CAUSES
        names = {
            "object": self.scene.all_names,
            "class": self.classes,
            "material": self.materials,
        }
        return names.get(column.name) or ()

    def save(self, path: Path) -> None:
        """Write it as a NumPy archive; the same content gives the same bytes."""
        names = {
            "objects": self.scene.names,
            "actors": [actor.name for actor in self.scene.actors],
            "sensors": [[way.name, way.model, way.moves] for way in self.sensors],
            "own": [asdict(column) for column in self.own],
            "coordinates": self.coordinates,
            "triangles": self.triangles,
            **({"classes": self.classes} if self.classes else {}),
            **({"materials": self.materials} if self.materials else {}),
        }
        arrays: dict[str, Any] = {
            "format": _FORMAT,
            "vertices": self.scene.vertices,
            "faces": self.scene.faces,
            "face_object": self.scene.face_object,
            # NumPy strings all have the length of the longest, and lose trailing zeros.
            "names": np.frombuffer(json.dumps(names).encode(), np.uint8),
            "origin": self.scene.origin,
            "duration_ns": self.duration_ns,
            "hit_counts": self.hit_counts,
            "sample_rays": self.sample_rays,
        }
        if self.reflectance is not None:
            arrays["reflectance"] = self.reflectance
        if self.scene.colours is not None:
            arrays["colours"] = self.scene.colours.means()
        for number, way in enumerate(self.sensors):
            arrays |= {f"sensor{number}_times": way.times_ns, f"sensor{number}": way.positions}
        for number, actor in enumerate(self.scene.actors):
            track = actor.trajectory
            if not isinstance(track, Track):
                raise TypeError(f"the trajectory of actor {actor.name!r} is not sampled")
            arrays |= {f"actor{number}_{n}": getattr(track, field) for n, field in _TRACK.items()}
            arrays[f"actor{number}_absent"] = track.beyond == "absent"
            if actor.mesh.animation is not None:
                arrays[f"actor{number}_offset"] = actor.offset_s
        meshes, arrays["actor_mesh"] = shapes_of(self.scene.actors)
        for number, mesh in enumerate(meshes):
            arrays |= {f"mesh{number}_vertices": mesh.vertices, f"mesh{number}_faces": mesh.faces}
            if mesh.colours is not None:
                arrays[f"mesh{number}_colours"] = mesh.colours.means()
            if (own := mesh.animation) is not None:  # differences compress to a third of the size
                steps = np.diff(own.vertices, axis=0, prepend=0)
                arrays[f"mesh{number}_steps"] = steps.astype(np.float32)
                arrays[f"mesh{number}_played"] = [own.step_s, own.speed_m_s or 0, own.repeat]
        if self.planning is not None and self.plan is not None:
            arrays |= {
                "ends": [self.planning.start, self.planning.target],
                "centres": self.planning.centres,
                "radii": self.planning.radii,
                "path": self.plan.path,
                "waypoints": np.array(self.trials),
            }
            arrays |= {name: getattr(self.plan, name) for name in _PLAN_NUMBERS}
        path.write_bytes(packed(arrays))

    @classmethod
    def load(cls, path: Path) -> PictureContent:
        """Read what `save` wrote; LidarError if it is damaged. Nothing in the file is run."""
        with open_archive(path) as archive:
            return cls._from_arrays(archive)

    @classmethod
    def _from_arrays(cls, arrays: Mapping[str, Any]) -> PictureContent:
        if (made := int(arrays["format"])) != _FORMAT:
            raise ValueError(f"it is of format {made}, not {_FORMAT}")
        names = json.loads(arrays["names"].tobytes())
        actors, which = [], arrays["actor_mesh"].tolist()
        meshes = [
            SceneMesh("", arrays[f"{mesh}_vertices"], arrays[f"{mesh}_faces"],
                 colours=_colours(arrays, f"{mesh}_colours"), animation=_animation(arrays, mesh))
            for mesh in (f"mesh{number}" for number in range(max(which, default=-1) + 1))
        ]  # fmt: skip
        for number, name in enumerate(names["actors"]):
            times, places, turns = (arrays[f"actor{number}_{part}"] for part in _TRACK)
            beyond: Beyond = "absent" if arrays[f"actor{number}_absent"] else "hold"
            way = Track(times, places, turns, start_s=0.0, beyond=beyond)
            offset_s = float(arrays.get(f"actor{number}_offset", 0))  # without poses, there is none
            actors.append(Actor(replace(meshes[which[number]], name=name), way, offset_s))
        scene = Scene(
            arrays["vertices"],
            arrays["faces"],
            arrays["face_object"],
            tuple(map(str, names["objects"])),
            arrays["origin"],
            tuple(actors),
            colours=_colours(arrays, "colours"),
        )
        sensors = [
            SensorWay(arrays[f"sensor{k}_times"], arrays[f"sensor{k}"], moves, name, model)
            for k, (name, model, moves) in enumerate(names["sensors"])
        ]
        counts = arrays["hit_counts"]
        if counts.shape != (scene.triangles,):
            raise ValueError(f"hit_counts of {counts.shape} for {scene.triangles} triangles")
        planning = plan = None
        if "path" in arrays:
            start, target = arrays["ends"]
            planning = Planning(start, target, arrays["centres"], arrays["radii"])
            numbers = {name: arrays[name].item() for name in _PLAN_NUMBERS}
            plan = Plan(path=arrays["path"], **numbers)
        rays, trials = arrays["sample_rays"], tuple(arrays.get("waypoints", ()))
        duration, own = float(arrays["duration_ns"]), [Column(**one) for one in names["own"]]
        fields = "coordinates", "triangles", "classes", "materials"
        rest = arrays.get("reflectance"), *map(names.get, fields)
        return cls(scene, sensors, counts, rays, planning, plan, trials, duration, own, *rest)


def _colours(arrays: Mapping[str, Any], name: str) -> Colours | None:
    """Colours of faces, if there are some."""
    return Colours.of_faces(arrays[name]) if name in arrays else None


def _animation(arrays: Mapping[str, Any], mesh: str) -> Animation | None:
    """Poses of a mesh, if it has some."""
    if (steps := arrays.get(f"{mesh}_steps")) is None:
        return None
    step_s, speed, repeat = arrays[f"{mesh}_played"].tolist()
    return Animation(steps.cumsum(0, np.float64), step_s, speed or None, bool(repeat))


def sensor_ways(survey: Survey) -> list[SensorWay]:
    """Positions of each sensor: at each station, or samples of its trajectory."""
    path, ways, first = survey.path, [], 0
    for carried, steps in zip(survey.carried, survey.steps_each, strict=True):
        end = first + steps * path.stations
        some: Iterable[int] = range(first, end, steps)  # the first at each station
        if path.moves:
            some = np.unique(np.linspace(first, end - 1, PLACES_MOST).astype(int)).tolist()
        times = np.array([survey.begins_ns(scan) for scan in some])
        places = np.array([survey.pose(scan).position for scan in some])
        ways.append(SensorWay(times, places, path.moves, carried.name, carried.sensor.model))
        first = end
    return ways


def ways_of(
    sensors: Sequence[SensorWay], actors: Sequence[Actor], duration_ns: float
) -> list[Floats]:
    """Trajectories (k, 3) of moving sensors, else of actors and the sensors; none without motion.

    Pictures and pages look at their surroundings.
    """
    moving = [way.positions for way in sensors if way.moves]
    if moving or not actors:
        return moving
    times = np.linspace(0, duration_ns, PLACES_MOST)
    ways = [actor.trajectory.poses(0, times)[0] for actor in actors]
    return [*(way.positions for way in sensors), *ways]


def _sampled(actor: Actor, duration_ns: float, count: int) -> Actor:
    """Return an actor with poses of a survey, whatever its trajectory is."""
    times, places, turns = actor.samples(duration_ns, count)
    beyond: Beyond = "hold" if presence_ns(actor.trajectory) == ALWAYS else "absent"
    shown = replace(actor, trajectory=Track(times / 1e9, places, turns, start_s=0.0, beyond=beyond))
    if (own := actor.mesh.animation) is None:
        return shown
    # The animation may follow the way, of which the samples lack the part before the survey.
    missing_s = actor.seconds(times[:1])[0] - shown.seconds(times[:1])[0]
    mesh = replace(actor.mesh, animation=own.pictured)
    return replace(shown, mesh=mesh, offset_s=actor.offset_s + float(missing_s[0]))
