"""Apply simulation steps to the pulses of recorded sweeps."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from raybeam import Pattern

from ..casting.actor_trajectories import ActorTrajectories
from ..casting.motion import CastPoses, FiringClock, Firings
from ..casting.scene_caster import casters_of_sensors
from ..casting.surfaces import SceneSurfaces
from ..motion.trajectory import CENTER
from ..numerics.arrays import Floats, Ints
from ..pulses.pulses import BeamRange, PulseCaster
from ..pulses.returns import PulseReturns
from ..pulses.steps.cast import has_bodies
from ..pulses.steps.step import RecordedPulses
from ..scene.actors import Actor
from ..scene.scene import Scene
from ..scene.scene_mesh import SceneMesh
from ..sensor import Noise, Returns, Sensor, Spin
from ..sensor.beams import Beams
from ..survey.survey import Mounted, ScanSpec, Survey
from .body_spheres import firings_near_bodies, ranges_of_firings

RECORDING = "recording"  # name of the invisible object that stands for recorded surfaces


@dataclass(frozen=True, eq=False)
class FiredPulses:
    """Pulses of a recorded sweep in a grid of f firings and c channels.

    Attributes
    ----------
    aim
        Function that returns the unit directions (f, c, 3) of the pulses in the sensor frame. It is
        called at most once, and only if an effect depends on the directions.
    firing_ns
        (f,): firing times in nanoseconds since the start of the recording.
    recorded
        Returns of the pulses. The ray of a pulse is ``firing * c + channel``.
    origins
        (f, c, 3): sensor positions at the firings in the sensor frame of the sweep, in meters, or
        None if all pulses start at the origin. They differ in motion-compensated sweeps.
    """

    aim: Callable[[], Floats]
    firing_ns: Floats
    recorded: RecordedPulses
    origins: Floats | None = None

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.recorded.fired) // max(len(self.firing_ns), 1)

    @cached_property
    def directions(self) -> Floats:
        """Unit directions of the pulses in the sensor frame, of shape (f, c, 3)."""
        return self.aim()

    @cached_property
    def pattern(self) -> Pattern:
        """Rays of the pulses."""
        origins = None if self.origins is None else self.origins.reshape(-1, 3)
        return Pattern(self.directions.reshape(-1, 3), origins, step=self.channels)


@dataclass(frozen=True, eq=False, repr=False)
class RecordedSensor(Sensor):
    """A sensor whose pulses were recorded. Each sweep has its own directions and times."""

    pulses: FiredPulses | None = None  # pulses of a sweep; None before a sweep is known

    @classmethod
    def create(cls, channels: int, firings: int, sensor: Sensor, max_range_m: float) -> Any:
        """Create a sensor with the optics and range limits of a sensor model.

        Parameters
        ----------
        channels
            Number of channels.
        firings
            Maximum number of firings of a sweep.
        sensor
            Sensor model.
        max_range_m
            Maximum range of the recorded returns in meters.
        """
        return cls(
            Beams(np.zeros(channels)),
            Spin(max(firings, 1), 360),
            min_range_m=sensor.min_range_m,
            max_range_m=max(max_range_m, sensor.max_range_m),
            name=sensor.model,
            optics=sensor.optics,
            noise=sensor.noise,
            returns=sensor.returns,
        )

    def directions(self, firings: Ints) -> Floats:
        """Return the recorded directions of firings in the sensor frame, of shape (k, c, 3)."""
        assert self.pulses is not None
        return self.pulses.directions[firings]

    def begins_ns(self, firings: Ints) -> Floats:
        """Return the firing times in nanoseconds since the start of the recording."""
        if self.pulses is None:
            return super().begins_ns(firings)
        return self.pulses.firing_ns[firings]

    def with_pulses(self, pulses: FiredPulses) -> RecordedSensor:
        """Return a copy with the pulses of a sweep."""
        sensor = copy(self)  # `replace` would check all fields of the sensor for each sweep
        object.__setattr__(sensor, "pulses", pulses)
        return sensor


def scene_of_bodies(objects: tuple[SceneMesh, ...] = (), actors: tuple[Actor, ...] = ()) -> Scene:
    """Create a scene of objects that are inserted into recorded sweeps.

    Coordinates are those of the recording's world frame. The scene also contains an invisible
    object that represents the recorded surfaces.
    """
    corners = np.array([[0.0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0]])
    recording = SceneMesh(RECORDING, corners, np.array([[0, 1, 2]]))
    scene = Scene.from_meshes([recording, *objects])
    return scene.with_actors(actors) if actors else scene


class PulseAugmenter:
    """Applies simulation steps to the pulses of recorded sweeps.

    Parameters
    ----------
    sensor
        Sensor of the recording (`RecordedSensor.create`).
    scene
        Inserted objects (`scene_of_bodies`).
    noise
        Noise of added returns, with the detection threshold of the sensor.
    recorded_noise
        Noise that is added to recorded returns.
    returns
        Sub-rays of beams at inserted objects, and the returns that are reported for each pulse.
    sweep_count
        Number of sweeps of the recording.
    **options
        Fields of `Survey`, such as `rain_mm_h`, `faults` and `materials`.
    """

    def __init__(
        self,
        sensor: RecordedSensor,
        scene: Scene,
        noise: Noise,
        recorded_noise: Noise,
        returns: Returns,
        sweep_count: int,
        **options: Any,
    ) -> None:
        self.scene = scene
        self.sensor = sensor
        mounted = Mounted(sensor, unseen=(RECORDING,))
        self.survey = Survey(
            sensors=[mounted],
            poses=[CENTER],
            steps=max(sweep_count, 1),
            noise=noise,
            returns=returns,
            **options,
        )
        self.surfaces = SceneSurfaces(
            scene, tuple(self.survey.materials), [sensor.optics.simulated_nm]
        )
        (caster,) = casters_of_sensors(scene, self.survey, self.surfaces)
        self._caster = caster
        self._pulses = PulseCaster(0, caster, scene, self.survey, self.surfaces, recorded_noise)
        # Most pulses cannot hit an object. They are not cast, and need no sub-rays.
        without_objects = replace(
            self.survey,
            sensors=[replace(mounted, unseen=("*",))],
            returns=replace(returns, subrays=1),
        )
        self._distant_pulses = PulseCaster(
            0, caster, scene, without_objects, self.surfaces, recorded_noise
        )
        self._actor_trajectories = ActorTrajectories.from_actors(scene.actors)

    @property
    def threshold(self) -> float:
        """Energy at which half of the returns are detected, or 0 without a detection range."""
        return self.survey.noise_each[0].threshold

    @property
    def saturation(self) -> float:
        """Energy at which the receiver saturates, or infinity if it never saturates."""
        return self.survey.noise_each[0].saturation_energy

    def apply(
        self, number: int, pulses: FiredPulses, pose: tuple[Floats, Floats] | None = None
    ) -> PulseReturns:
        """Return the reported returns of a sweep.

        Parameters
        ----------
        number
            Number of the sweep, on which all random numbers depend.
        pulses
            Pulses of the sweep.
        pose
            Position (3,) and rotation (3, 3) of the frame of the rays in the world frame, or
            positions (f, 3) and rotations (f, 3, 3) of all firings. None for the identity.

        Returns
        -------
        PulseReturns
            Returns of the pulses that were fired. `source` is the row of a recorded return in
            `pulses.recorded`, and `reported` is the range with noise in meters.
        """
        rays = len(pulses.recorded.fired)
        spec = ScanSpec(number, 0, (0, len(pulses.firing_ns)), channels=pulses.channels)
        poses = self._poses(pulses, pose)
        self._caster.ensure_trees(np.atleast_2d(poses.positions))
        scanned = self._pulses.scan(
            number,
            lambda: pulses.pattern,
            poses,
            (0, rays),
            np.zeros(1, np.int64),
            Firings.from_scans(self.sensor.with_pulses(pulses), [spec]),
            tally=False,
            recorded=pulses.recorded,
            ranges=self._ranges(pulses, poses),
        )
        returns = scanned.returns
        return returns.take(pulses.recorded.fired[returns.ray])

    def pulses_on_objects(
        self, pulses: FiredPulses, pose: tuple[Floats, Floats] | None, count: int
    ) -> Ints:
        """Return the number of pulses that would hit each inserted object in clear air.

        The parameters are those of `apply`. The result has shape (count,).
        """
        poses = self._poses(pulses, pose)
        sensor = self.sensor
        counts = np.zeros(count, np.int64)
        for caster, start, stop in self._ranges(pulses, poses):
            if caster is self._distant_pulses:
                continue
            hits = self._caster.scan(
                pulses.pattern,
                poses.for_subrays(start, stop, 1),
                window=(start, stop),
                t_min=sensor.min_range_m,
                t_max=sensor.max_range_m,
            )
            fired = pulses.recorded.fired[start + hits.ray]
            _, objects, _ = self.surfaces.triangles.locate(hits.triangle[fired])
            counts += np.bincount(objects - 1, minlength=count)
        return counts

    def _ranges(self, pulses: FiredPulses, poses: CastPoses) -> list[BeamRange]:
        """Divide the pulses of a sweep into those that can hit an object, and those that cannot."""
        channels = pulses.channels
        if not has_bodies(self._pulses.setup):
            return []
        near = firings_near_bodies(
            self.scene,
            self._pulses.emitter.beam,
            poses,
            pulses.firing_ns,
            pulses.directions,
            pulses.origins,
        )
        return [
            BeamRange(
                self._pulses if is_near else self._distant_pulses, start * channels, stop * channels
            )
            for start, stop, is_near in ranges_of_firings(near, channels)
        ]

    def _poses(self, pulses: FiredPulses, pose: tuple[Floats, Floats] | None) -> CastPoses:
        """Return the poses of the rays of a sweep in the scene frame, with the clock of actors."""
        position, rotation = (np.zeros(3), None) if pose is None else pose
        poses = CastPoses(
            position - self.scene.origin,
            rotation,
            rays_per_pose=None if position.ndim == 1 else pulses.channels,
        )
        if not self.scene.actors:
            return poses
        sensor = self.sensor
        clock = FiringClock(pulses.firing_ns, sensor.beams.time_ns, self._actor_trajectories)
        return replace(poses, clock=clock)

    def objects(self, returns: PulseReturns) -> Ints:
        """Return the number of the inserted object of each return, or -1 if there is none.

        Numbers are indices into `scene.object_names` without the recording itself, so the first
        inserted object has the number 0.
        """
        numbers = np.full(len(returns.ray), -1)
        source = returns.source
        is_cast = (returns.triangle >= 0) & ((source < 0) if source is not None else True)
        rows = np.flatnonzero(is_cast)
        _, objects, _ = self.surfaces.triangles.locate(returns.triangle[rows])
        numbers[rows] = objects - 1
        return numbers
