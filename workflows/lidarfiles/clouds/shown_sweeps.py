"""Surroundings and sweeps, prepared for live views and viewer recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from lidarsim.columns.cloud import Cloud
from lidarsim.numerics.arrays import AnyArray, Bytes, Floats, Floats32, Ints32
from lidarsim.packets.encoders import START_NS
from lidarsim.scene.scene import Scene
from lidarsim.scene.simplified import SimplifiedScene, cut_masks, simplify_scene
from lidarsim.sweeps.sweeps import Sweeps

from ..picture_file import PictureContent
from .boxes import Boxes
from .frame_names import VEHICLE, WORLD, frame_names, points_topic, survey_start_ns

MAX_TRIANGLES = 200_000  # maximum number of triangles that viewers show
MAX_POSITIONS = 10_000  # maximum number of positions in a trajectory
_ORIGIN_STEP_M = 10_000.0
# Types that viewers do not support, and the types to which they are converted.
_SENT_TYPES = {"i8": np.float64, "u8": np.float64, "b1": np.uint8, "f2": np.float32}


@dataclass(frozen=True, eq=False)
class FramePose:
    """Pose of a frame in its parent."""

    parent: str
    name: str
    position: Floats  # (3,), meters
    quaternion: Floats  # (4,): x, y, z, w of the rotation from the frame to its parent


@dataclass(frozen=True, eq=False)
class Surface:
    """Static triangles of a scene, for display."""

    vertices: Floats32  # (v, 3): meters, relative to `origin`
    faces: Ints32  # (f, 3)
    colors: Bytes | None  # (f, 3): sRGB colors, or None for a gray scene
    origin: Floats  # (3,): origin of the vertices in world coordinates, in meters

    @classmethod
    def from_scene(cls, scene: Scene, max_triangles: int = MAX_TRIANGLES) -> Surface:
        """Return the triangles of a scene and its instances, simplified to `max_triangles`."""
        drawn = SimplifiedScene.from_scene(cut_masks(scene)).scene
        if len(drawn.faces) > max_triangles:
            drawn, _ = simplify_scene(drawn, max_triangles)
        return cls(
            drawn.vertices.astype(np.float32),
            drawn.faces.astype(np.int32),
            None if drawn.colors is None else drawn.colors.mean_colors(),
            drawn.origin,
        )


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Static content that viewers show in addition to the sweeps."""

    surface: Surface | None = None
    # {name of the frame: positions of shape (k, 3) in world coordinates, in meters}
    trajectories: Mapping[str, Floats] = field(default_factory=dict)
    # (w, 3): corners of the planned path in world coordinates, in meters.
    path: Floats | None = None
    classes: Mapping[int, str] = field(default_factory=dict)  # {number: name}
    start_ns: int = START_NS  # start of the survey in ns since 1970-01-01 UTC
    topics: Sequence[str] = ()  # topics of the points in the sweeps that follow
    has_actors: bool = False  # whether the sweeps that follow have boxes of actors

    @property
    def origin(self) -> Floats:
        """Position in world coordinates that is subtracted from all positions.

        Viewers store coordinates as float32, which is too imprecise for world coordinates.
        """
        if self.surface is not None:
            return self.surface.origin
        positions = next(iter(self.trajectories.values()), np.zeros((1, 3)))
        return np.round(positions[0] / _ORIGIN_STEP_M) * _ORIGIN_STEP_M

    @classmethod
    def from_sweeps(cls, sweeps: Sweeps, content: PictureContent | None = None) -> Surroundings:
        """Create the surroundings of sweeps.

        `content` provides the scene and the planned path. It is ignored unless it is in world
        coordinates.
        """
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
        """Create surroundings with the scene and the planned path from a result's plot data."""
        best = None if content.planning is None else content.planning.best
        return cls(
            Surface.from_scene(content.scene),
            trajectories,
            None if best is None else path_in_world(best.corners, content.scene.origin),
        )


def path_in_world(corners: Floats, origin: Floats) -> Floats:
    """Convert the corners of a planned path from local 2D coordinates to 3D world coordinates."""
    return np.pad(corners, ((0, 0), (0, 1))) + origin


@dataclass(frozen=True, eq=False)
class ActorBoxes:
    """Boxes of the actors in a sweep, with the names of the actors.

    The boxes are defined as in `Boxes`. Positions and sizes are in meters, in world coordinates.
    """

    names: Sequence[str]
    types: Sequence[str]
    centers: Floats  # (a, 3)
    quaternions: Floats  # (a, 4): x, y, z, w
    sizes: Floats  # (a, 3)
    points: Sequence[int]  # number of points in the sweep on each actor
    present: Sequence[bool]

    @classmethod
    def from_points(cls, sweeps: Sweeps, sweep: int, points: Cloud) -> ActorBoxes:
        """Compute the boxes of all actors in a sweep, given the points of the sweep."""
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
    """A sweep for viewers, with points in the sensor frame at the start of the sweep."""

    start_ns: int  # start of the sweep in ns since 1970-01-01 UTC
    stamp_ns: int  # start of the sweep according to the sensor's clock, which may be faulty
    topic: str
    frame: str
    positions: Floats32  # (n, 3): meters
    columns: Mapping[str, AnyArray]  # {name: (n,)}: integers of at most 32 bits, or floats
    transforms: Sequence[FramePose]  # poses of the frames at the start of the sweep
    boxes: ActorBoxes | None = None  # None if there are no actors


class SweepSequence:
    """Sequence of a survey's sweeps, converted for viewers."""

    def __init__(self, sweeps: Sweeps) -> None:
        self.sweeps = sweeps
        self.start_ns = survey_start_ns(sweeps)
        self._frames = frame_names(sweeps.sensors, sweeps.actors)
        self._actor_frames = self._frames[len(sweeps.sensors) :][: len(sweeps.actors)]
        mounts = zip(sweeps.mounts.positions, sweeps.mounts.quaternions, strict=True)
        self._mounts = [
            FramePose(VEHICLE, self._frames[number], *mount) for number, mount in enumerate(mounts)
        ]

    def shown_sweep(self, sweep: int, points: Cloud) -> ShownSweep:
        """Convert a sweep, given its number and its points."""
        sweeps = self.sweeps
        sensor = sweeps.sensor[sweep]
        return ShownSweep(
            start_ns=self.start_ns + round(sweeps.begins_ns[sweep]),
            stamp_ns=self.start_ns + sweeps.stamp_ns(sweep),
            topic=points_topic(sweeps.sensors[sensor], self._frames[sensor]),
            frame=self._frames[sensor],
            positions=sweeps.compensate_motion(sweep, points).astype(np.float32),
            columns=viewer_columns(sweeps.columns_compensated(sweep, points)),
            transforms=self._transforms(sweep),
            boxes=ActorBoxes.from_points(sweeps, sweep, points) if sweeps.actors else None,
        )

    def _transforms(self, sweep: int) -> list[FramePose]:
        """Return the poses of the vehicle, its sensors and the actors that are in the scene."""
        sweeps = self.sweeps
        carrier = sweeps.platform
        frames = [
            FramePose(WORLD, VEHICLE, carrier.positions[sweep], carrier.quaternions[sweep]),
            *self._mounts,
        ]
        poses = sweeps.actor_poses
        return frames + [
            FramePose(WORLD, frame, poses.positions[actor, sweep], poses.quaternions[actor, sweep])
            for actor, frame in enumerate(self._actor_frames)
            if sweeps.actor_there[actor, sweep]
        ]


def viewer_columns(columns: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """Return the numeric columns with types that viewers support.

    64-bit integers become float64. Waveforms are omitted.
    """
    numbers = {name: values for name, values in columns.items() if values.dtype.kind in "biuf"}
    return {
        name: values.astype(_SENT_TYPES.get(values.dtype.str[1:], values.dtype), copy=False)
        for name, values in numbers.items()
    }
