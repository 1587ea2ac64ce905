"""Objects that are inserted into recorded sweeps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from lidarfiles.clouds.boxes import SweepBoxes
from lidarfiles.clouds.recording import Recording
from lidarsim.errors import LidarError
from lidarsim.media.materials import Material
from lidarsim.motion.rotations import quaternions_of
from lidarsim.motion.trajectory import Track, full_poses
from lidarsim.numerics.arrays import AnyArray, Floats, Ints
from lidarsim.pulses.returns import PulseReturns
from lidarsim.scene.actors import Actor
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.simulator.recorded_sweeps import FiredPulses, PulseAugmenter, scene_of_bodies
from lidarsim.words import did_you_mean, join_names, make_distinct, plural

from .effects import Effects, Insertion
from .ground_plane import GroundPlane
from .object_classes import find_class
from .sensor_motion import SensorMotion, SweepMotion

_FIRST_OBJECT = 60_000  # number of the first inserted object if the objects have no names


@dataclass(frozen=True, eq=False)
class InsertedObjects:
    """Objects that are inserted into the sweeps of a recording.

    Attributes
    ----------
    scene
        Scene of the objects in the world frame of the recording, minus `SensorMotion.shift`.
    names, types
        (k,): names of the objects, and names of their classes.
    classes
        (k,): semantic class numbers of the objects.
    materials
        Materials of the objects.
    notes
        Notes for the user.
    """

    scene: Scene
    names: tuple[str, ...] = ()
    types: tuple[str, ...] = ()
    classes: tuple[int, ...] = ()
    materials: tuple[Material, ...] = ()
    # (k, 2, 3): bounds of the objects in their own frames, meters
    bounds: Floats = field(default_factory=lambda: np.zeros((0, 2, 3)))
    # {number of a stationary object: pose in the world frame (4, 4)}
    placed: Mapping[int, Floats] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @classmethod
    def from_effects(
        cls, recording: Recording, effects: Effects, motion: SensorMotion
    ) -> InsertedObjects:
        """Place the objects of effects in a recording, whose sensor motion is known.

        Raises
        ------
        LidarError
            If two actors have the same name, if the class of an object is unknown, or if the
            recorded ground below an object is unknown.
        """
        if not effects.actors and not effects.insertions:
            return cls(scene_of_bodies(), materials=effects.materials)
        notes = []
        if motion.poses is None:
            notes.append(
                f"The poses of {recording.info.name} are unknown, so inserted objects move with "
                "the sensor."
            )
        first_pose = np.eye(4) if motion.poses is None else motion.poses[0]
        ground = GroundPlane.from_sweep(recording[0]) if effects.insertions else None
        names = _names(effects)
        meshes: list[SceneMesh] = []
        placed: dict[int, Floats] = {}
        sensor_positions = np.zeros((1, 3)) if motion.poses is None else motion.poses[:, :3, 3]
        for number, insertion in enumerate(effects.insertions):
            assert ground is not None
            mesh = replace(insertion.mesh, name=names[number], animation=None)
            pose = first_pose @ _sensor_pose(insertion, mesh, ground, recording.info.name)
            placed[number] = pose
            notes += _position_notes(mesh, pose, sensor_positions)
            vertices = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
            meshes.append(replace(mesh, vertices=vertices))
        actors = tuple(_shifted(actor, motion.shift) for actor in effects.actors)
        types = [
            insertion.class_name or _type(insertion.mesh.name) for insertion in effects.insertions
        ]
        types += [_type(actor.name) for actor in actors]
        classes, class_notes = _classes(effects, types, names, recording)
        bounds = [_bounds(insertion.mesh) for insertion in effects.insertions]
        bounds += [_bounds(actor.mesh) for actor in actors]
        return cls(
            scene_of_bodies(tuple(meshes), actors),
            tuple(names),
            tuple(types),
            classes,
            effects.materials,
            np.array(bounds),
            placed,
            (*notes, *class_notes),
        )

    @property
    def has_objects(self) -> bool:
        """Whether there are objects to insert."""
        return bool(self.names)

    @property
    def surface_materials(self) -> tuple[Material, ...]:
        """Materials of all objects, including those without a material of the user."""
        if not self.materials or self.materials[-1].applies_to_all:
            return self.materials
        return (*self.materials, Material("*"))

    def label(
        self, columns: dict[str, AnyArray], added: Ints, numbers: Ints, named_objects: int
    ) -> None:
        """Set the classes and objects of added points.

        Points in the air have class 0 and no object. If objects are inserted, the columns are added
        to recordings that lack them.

        Parameters
        ----------
        columns
            Columns of all points, which are changed.
        added
            Rows of the added points.
        numbers
            Inserted object of each added point, or -1.
        named_objects
            Number of objects that are named in the recording.
        """
        if self.has_objects:
            count = len(columns["cause"])
            columns.setdefault("object", np.full(count, -1, np.int32))
            columns.setdefault("class", np.zeros(count, np.uint16))
        if "class" in columns:
            classes = np.array([*self.classes, 0])
            columns["class"][added] = classes[numbers]
        if "object" in columns:
            first = named_objects or _FIRST_OBJECT
            columns["object"][added] = np.where(numbers >= 0, first + numbers, -1)

    def boxes(
        self,
        simulation: PulseAugmenter,
        pulses: FiredPulses,
        motion: SweepMotion,
        returns: PulseReturns,
        number: int,
    ) -> tuple[SweepBoxes, Floats]:
        """Return the bounding boxes of objects in the frame of a sweep, and their visibility.

        Objects that are beyond the range of the sensor have no box.
        """
        count = len(self.names)
        if not count:
            return _boxes((), (), np.zeros((0, 4, 4)), self.bounds, np.zeros(0, int), 0), np.zeros(
                0
            )
        objects = simulation.objects(returns)
        hits = np.flatnonzero(objects >= 0)
        rays = len(pulses.recorded.fired)
        visible = np.unique(objects[hits] * rays + returns.ray[hits]) // rays
        visible = np.bincount(visible, minlength=count)
        points = np.bincount(objects[objects >= 0], minlength=count)
        alone = simulation.pulses_on_objects(pulses, motion.poses, count)
        back = np.linalg.inv(motion.stamp_pose)
        start_ns = float(pulses.firing_ns[0]) if len(pulses.firing_ns) else 0.0
        matrices_4 = np.array([back @ self._pose(k, start_ns) for k in range(count)])
        in_reach = alone > 0
        visibility = visible / np.maximum(alone, 1)
        chosen = np.flatnonzero(in_reach)
        boxes = _boxes(
            tuple(self.names[k] for k in chosen),
            tuple(self.types[k] for k in chosen),
            matrices_4[chosen],
            self.bounds[chosen],
            points[chosen],
            _FIRST_OBJECT,
            chosen,
        )
        return boxes, np.minimum(visibility[chosen], 1.0)

    def _pose(self, number: int, time_ns: float) -> Floats:
        """Return the pose of an object in the world frame, of shape (4, 4)."""
        if number in self.placed:
            return self.placed[number]
        actor = self.scene.actors[number - len(self.placed)]
        positions, rotations = full_poses(actor.trajectory, 0, np.array([time_ns]))
        pose = np.eye(4)
        pose[:3, :3] = rotations[0]
        pose[:3, 3] = positions[0] + self.scene.origin
        return pose


def _boxes(
    names: tuple[str, ...],
    types: tuple[str, ...],
    poses: Floats,
    bounds: Floats,
    points: Ints,
    first: int,
    numbers: Any = (),
) -> SweepBoxes:
    centers = bounds.mean(axis=1)
    centers = np.einsum("kij,kj->ki", poses[:, :3, :3], centers) + poses[:, :3, 3]
    quaternions = quaternions_of(poses[:, :3, :3]) if len(poses) else np.zeros((0, 4))
    return SweepBoxes(
        names,
        types,
        (first + np.asarray(numbers, np.int64)).astype(np.int32),
        centers,
        quaternions,
        bounds[:, 1] - bounds[:, 0],
        points,
    )


def _names(effects: Effects) -> list[str]:
    """Return the distinct names of the insertions and the actors.

    Raises LidarError if two actors have the same name.
    """
    actors = [actor.name for actor in effects.actors]
    for name in actors:
        if actors.count(name) > 1:
            raise LidarError(f"Two inserted objects are named {name!r}. Rename one of them.")
    insertions = [insertion.name or insertion.mesh.name for insertion in effects.insertions]
    distinct = make_distinct([*actors, *insertions])
    return [*distinct[len(actors) :], *actors]


def _sensor_pose(insertion: Insertion, mesh: SceneMesh, ground: GroundPlane, name: str) -> Floats:
    """Return the pose of an insertion in the sensor frame of the first sweep, of shape (4, 4)."""
    heading = np.radians(insertion.heading_deg)
    pose = np.eye(4)
    forward = np.array([np.cos(heading), np.sin(heading), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    if insertion.z_m is None:
        z_m, up = ground.at(insertion.x_m, insertion.y_m, mesh.name, name)
        z_m -= float(mesh.vertices[:, 2].min())
    else:
        z_m = insertion.z_m
    left = np.cross(up, forward)
    left /= np.linalg.norm(left)
    pose[:3, :3] = np.stack([np.cross(left, up), left, up], axis=1)
    pose[:3, 3] = insertion.x_m, insertion.y_m, z_m
    return pose


def _position_notes(mesh: SceneMesh, pose: Floats, sensor_positions: Floats) -> list[str]:
    """Return a note if an object is around the sensor, or directly below or above it.

    `sensor_positions` are those of the sweeps, with shape (n, 3).
    """
    positions = (sensor_positions - pose[:3, 3]) @ pose[:3, :3]
    low, high = _bounds(mesh)
    is_in_bounds = (positions >= low) & (positions <= high)
    is_close = is_in_bounds[:, 0] & is_in_bounds[:, 1]
    if not is_close.any():
        return []
    is_inside = is_close & is_in_bounds[:, 2]
    concerned = is_inside if is_inside.any() else is_close
    is_below = positions[concerned.argmax(), 2] > high[2]
    relation = "contains" if is_inside.any() else "is below" if is_below else "is above"
    count = len(positions)
    times = "" if count == 1 else f" in {concerned.sum():,} of {plural(count, 'sweep')}"
    return [f"The inserted object {mesh.name!r} {relation} the sensor{times}. Check its position."]


def _shifted(actor: Actor, shift: Floats) -> Actor:
    if not shift.any():
        return actor
    track = actor.trajectory
    if not isinstance(track, Track):
        raise LidarError(
            f"The recording is {np.abs(shift).max():.0f} m from the origin of its world frame, "
            f"and the actor {actor.name!r} has no track. Set its `trajectory.points`."
        )
    return actor.with_trajectory(replace(track, positions=track.positions - shift))


def _type(name: str) -> str:
    """Return the name of an object without a number at its end."""
    return name.rstrip("0123456789").strip(" _-") or name


def _bounds(mesh: SceneMesh) -> Floats:
    return np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)])


def _classes(
    effects: Effects, types: list[str], names: list[str], recording: Recording
) -> tuple[tuple[int, ...], list[str]]:
    """Return the class number of each object, and notes about classes without a number.

    Raises
    ------
    LidarError
        If a class is unknown although the classes of the recording have names.
    """
    numbers = {name: number for number, name in {**recording.classes, **effects.classes}.items()}
    result = []
    unknown = []
    for index, (kind, name) in enumerate(zip(types, names, strict=True)):
        material = next(
            (m for m in effects.materials if m.semantic_class is not None and _selects(m, name)),
            None,
        )
        if index < len(effects.insertions) and effects.insertions[index].class_name:
            is_number = kind.isdecimal()
            known = find_class(kind, numbers)
            if numbers and known is None and not is_number:
                hint = did_you_mean(kind, numbers) or f" Known classes: {', '.join(numbers)}."
                raise LidarError(f"Unknown class {kind!r} of the inserted object {name!r}.{hint}")
            if not numbers and not is_number:
                unknown.append(kind)
            result.append(int(kind) if is_number else numbers.get(known or kind, 0))
        elif material is not None:
            result.append(int(material.semantic_class))
        else:
            result.append(0)
    if not unknown or "class" not in recording[0].columns:
        return tuple(result), []
    note = (
        f"{recording.info.name} does not state the numbers of its classes, so the points of the "
        f"class {join_names(sorted({*unknown}))} have class 0. Pass a number, for example `--class "
        "10`, or set `classes` in an effects file."
    )
    return tuple(result), [note]


def _selects(material: Material, name: str) -> bool:
    """Return whether a material selects an object by its name."""
    patterns = (material.objects,) if isinstance(material.objects, str) else material.objects
    return patterns is None or any(fnmatchcase(name, pattern) for pattern in patterns)
