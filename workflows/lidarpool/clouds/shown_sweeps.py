"""What live views and recordings for viewers show of a survey: surroundings, and each sweep."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from lidarsim.base.arrays import AnyArray, Bytes, Floats, Floats32, Ints32
from lidarsim.columns.cloud import Cloud
from lidarsim.packets.encoders import START_NS
from lidarsim.scene.scene import Scene
from lidarsim.scene.simplified import SimplifiedScene, cut_masks, simplified
from lidarsim.sweeps.sweeps import Sweeps
from lidarview.picture_file import PictureContent

from .boxes import Boxes
from .frame_names import CARRIER, WORLD, frame_names, points_topic, survey_start_ns

MAX_TRIANGLES = 200_000  # triangles of the scene in viewers
MAX_POSITIONS = 10_000  # positions of a trajectory
_ORIGIN_STEP_M = 10_000.0
# Column types that viewers hold: {kind and size of other columns: the type sent instead}.
_SENT_TYPES = {"i8": np.float64, "u8": np.float64, "b1": np.uint8, "f2": np.float32}


@dataclass(frozen=True, eq=False)
class Transform:
    """Pose of a frame in its parent."""

    parent: str
    name: str
    position: Floats  # (3,), meters
    quaternion: Floats  # (4,): x, y, z, w of the rotation from the frame to its parent


@dataclass(frozen=True, eq=False)
class Surface:
    """Static triangles of a scene."""

    vertices: Floats32  # (v, 3), meters, local coordinates
    faces: Ints32  # (f, 3)
    colors: Bytes | None  # (f, 3), sRGB; None for a gray scene
    origin: Floats  # (3,), world coordinates of the local origin, meters

    @classmethod
    def from_scene(cls, scene: Scene, max_triangles: int = MAX_TRIANGLES) -> Surface:
        """Return the triangles of a scene with its instances, simplified to a maximum number."""
        drawn = SimplifiedScene.from_scene(cut_masks(scene)).scene
        if len(drawn.faces) > max_triangles:
            drawn, _ = simplified(drawn, max_triangles)
        return cls(
            drawn.vertices.astype(np.float32),
            drawn.faces.astype(np.int32),
            None if drawn.colors is None else drawn.colors.means(),
            drawn.origin,
        )


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What viewers show beside the sweeps, once: scene, trajectories and planned path."""

    surface: Surface | None = None
    # {name of a frame: positions (k, 3)}, meters, world coordinates
    trajectories: Mapping[str, Floats] = field(default_factory=dict)
    path: Floats | None = None  # (w, 3): corners of the planned path, meters, world coordinates
    classes: Mapping[int, str] = field(default_factory=dict)  # {number: name}
    start_ns: int = START_NS  # start of the survey, since 1970-01-01 UTC
    topics: Sequence[str] = ()  # topics of the points of sweeps that will follow
    has_actors: bool = False  # True if these sweeps have boxes

    @property
    def origin(self) -> Floats:
        """World coordinates, (3,), that viewers with float32 coordinates subtract, meters."""
        if self.surface is not None:
            return self.surface.origin
        positions = next(iter(self.trajectories.values()), np.zeros((1, 3)))
        return np.round(positions[0] / _ORIGIN_STEP_M) * _ORIGIN_STEP_M

    @classmethod
    def from_sweeps(cls, sweeps: Sweeps, content: PictureContent | None = None) -> Surroundings:
        """Return the surroundings of sweeps, with scene and path of the pictures' content."""
        frames = frame_names(sweeps.sensors, sweeps.actors)
        positions_by_sensor = {
            frames[number]: sweeps.pose.positions[sweeps.sensor == number]
            for number in range(len(sweeps.sensors))
        }
        trajectories = {
            frame: positions[:: len(positions) // MAX_POSITIONS + 1]
            for frame, positions in positions_by_sensor.items()
            if len(positions) > 1
        }
        if content is None or content.coordinates != "world":
            surroundings = cls(trajectories=trajectories)
        else:
            surroundings = cls.from_content(content, trajectories)
        return replace(
            surroundings,
            classes=sweeps.classes,
            start_ns=survey_start_ns(sweeps),
            topics=[*map(points_topic, sweeps.sensors, frames)],
            has_actors=bool(sweeps.actors),
        )

    @classmethod
    def from_content(
        cls, content: PictureContent, trajectories: Mapping[str, Floats] = MappingProxyType({})
    ) -> Surroundings:
        """Return the surroundings with the scene and the path of the content of pictures."""
        best = None if content.planning is None else content.planning.best
        return cls(
            Surface.from_scene(content.scene),
            trajectories,
            None if best is None else path_in_world(best.corners, content.scene.origin),
        )


def path_in_world(corners: Floats, origin: Floats) -> Floats:
    """Return the corners (w, 3) of a planned path, local (w, 2), in world coordinates, meters."""
    return np.pad(corners, ((0, 0), (0, 1))) + origin


@dataclass(frozen=True, eq=False)
class ActorBoxes:
    """Boxes of the actors in a sweep, a in number, as in `Boxes`, meters, world coordinates."""

    names: Sequence[str]
    types: Sequence[str]
    centers: Floats  # (a, 3)
    quaternions: Floats  # (a, 4): x, y, z, w
    sizes: Floats  # (a, 3)
    points: Sequence[int]  # points of the sweep on each actor
    present: Sequence[bool]

    @classmethod
    def from_points(cls, sweeps: Sweeps, sweep: int, points: Cloud) -> ActorBoxes:
        """Return the boxes of all actors in a sweep with its points."""
        boxes = Boxes.from_points(sweeps, sweep, points)
        return cls(
            names=sweeps.actors,
            types=sweeps.actor_types,
            centers=boxes.centers,
            quaternions=boxes.quaternions,
            sizes=boxes.sizes,
            points=boxes.points.tolist(),
            present=boxes.present.tolist(),
        )


@dataclass(frozen=True, eq=False)
class ShownSweep:
    """A sweep for viewers: points in the frame of the sensor when the sweep began."""

    start_ns: int  # start of the sweep, since 1970-01-01 UTC
    stamp_ns: int  # the same by the sensor's clock, which faults may have moved
    topic: str
    frame: str
    positions: Floats32  # (n, 3), meters
    columns: Mapping[str, AnyArray]  # {name: (n,)}, numbers of at most 32 bits or float64
    transforms: Sequence[Transform]  # transforms of the frames at the start of the sweep
    boxes: ActorBoxes | None = None  # None without actors


class SweepSequence:
    """Makes the shown sweeps of a survey."""

    def __init__(self, sweeps: Sweeps) -> None:
        self.sweeps = sweeps
        self.start_ns = survey_start_ns(sweeps)
        self._frames = frame_names(sweeps.sensors, sweeps.actors)
        self._actor_frames = self._frames[len(sweeps.sensors) :][: len(sweeps.actors)]
        mounts = zip(sweeps.mounts.positions, sweeps.mounts.quaternions, strict=True)
        self._mounts = [
            Transform(CARRIER, self._frames[number], *mount) for number, mount in enumerate(mounts)
        ]

    def show(self, sweep: int, points: Cloud) -> ShownSweep:
        """Return the shown sweep of a number with its points."""
        sweeps = self.sweeps
        sensor = sweeps.sensor[sweep]
        return ShownSweep(
            start_ns=self.start_ns + round(sweeps.begins_ns[sweep]),
            stamp_ns=self.start_ns + sweeps.stamp_ns(sweep),
            topic=points_topic(sweeps.sensors[sensor], self._frames[sensor]),
            frame=self._frames[sensor],
            positions=sweeps.compensated(sweep, points).astype(np.float32),
            columns=sendable(sweeps.columns_compensated(sweep, points)),
            transforms=self._transforms(sweep),
            boxes=ActorBoxes.from_points(sweeps, sweep, points) if sweeps.actors else None,
        )

    def _transforms(self, sweep: int) -> list[Transform]:
        """Return the frames of the carrier, its sensors and the actors present in a sweep."""
        sweeps = self.sweeps
        carrier = sweeps.carrier
        frames = [
            Transform(WORLD, CARRIER, carrier.positions[sweep], carrier.quaternions[sweep]),
            *self._mounts,
        ]
        poses = sweeps.actor_poses
        return frames + [
            Transform(WORLD, frame, poses.positions[actor, sweep], poses.quaternions[actor, sweep])
            for actor, frame in enumerate(self._actor_frames)
            if sweeps.actor_there[actor, sweep]
        ]


def sendable(columns: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """Return the columns of numbers, integers of 64 bits as float64, without waveforms."""
    numbers = {name: values for name, values in columns.items() if values.dtype.kind in "biuf"}
    return {
        name: values.astype(_SENT_TYPES.get(values.dtype.str[1:], values.dtype), copy=False)
        for name, values in numbers.items()
    }
