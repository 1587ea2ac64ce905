"""Interface of the simulation steps. Each step is one effect on the pulses of a sensor.

`step_list.py` lists the steps in their order. A step is a class that declares its role, when it
applies, the columns that it reads and writes, its random numbers and its memory. Nothing else
decides whether a step acts, and how rays are cast follows from the roles of the steps that apply.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from enum import Flag, auto
from functools import cached_property
from typing import ClassVar, NamedTuple, Self

import numpy as np

from raybeam import Pattern, SubRays

from ...casting.motion import CastPoses, Firings
from ...casting.scene_caster import SceneCaster
from ...casting.surfaces import SceneSurfaces
from ...columns.table import VELOCITY
from ...numerics.arrays import Bools, Floats, Indices, Ints
from ...numerics.random_numbers import Purpose
from ...numerics.vectors import rotate
from ...scene.scene import Scene
from ...sensor import Noise, Returns, Sensor
from ...survey.faults import Fault, FaultKind
from ...survey.survey import Survey
from ..returns import Keys, Planes, PulseReturns


class Role(Flag):
    """Roles of simulation steps.

    Each step declares one or more flags.
    """

    AIMS = auto()  # deflects beams before they are cast
    ABOUT_AXIS = auto()  # deflects beams in azimuth and elevation, not horizontally and vertically
    CHANGES = auto()  # can remove or add returns, change energies, or add waveforms
    # Like CHANGES, for returns that the receiver adds or merges before `SelectionStep`.
    RECEIVES = auto()
    # Acts once on the selected, thinned-out returns of all pulses that are cast together.
    ON_REPORTED = auto()
    FRAME = auto()  # casts rays, combines hits into returns, or selects returns


@dataclass(frozen=True, eq=False)
class Setup:
    """A sensor of a survey in a scene, which determines the simulation steps that apply."""

    scene: Scene
    survey: Survey
    number: int  # number of the sensor in the survey
    # Roles of all steps that apply, except `Role.FRAME`; None until the steps have been chosen.
    roles: Role | None
    # Noise that is added to recorded returns, which already contain the noise of the sensor. None
    # if pulses are cast.
    recorded_noise: Noise | None = None

    @property
    def sensor(self) -> Sensor:
        """The simulated sensor."""
        return self.survey.mounted_sensors[self.number].sensor

    @property
    def noise(self) -> Noise:
        """Noise settings of the sensor."""
        return self.survey.noise_each[self.number]

    @property
    def is_recorded(self) -> bool:
        """Whether the returns of recorded pulses take the place of cast rays."""
        return self.recorded_noise is not None

    @property
    def reporting(self) -> Returns:
        """Beam profile of the sensor, and the mode that selects its reported returns."""
        return self.survey.returns_each[self.number]

    @property
    def half_pulse_m(self) -> float:
        """Half the pulse length in meters, which is the smallest gap between two returns."""
        return self.reporting.min_gap_m(self.sensor.optics)

    @property
    def has_velocities(self) -> bool:
        """Whether a stored column needs the radial velocities of returns."""
        return any(column.name == VELOCITY for column in self.survey.stored_columns)

    @property
    def leafy(self) -> bool:
        """Whether the scene has crowns, which are bodies or voxels with leaves."""
        crowns = any(m.leaf_area_density is not None for m in self.survey.materials)
        return crowns or bool(self.scene.has_voxels.any())

    @property
    def has_onward_light(self) -> bool:
        """Whether light can continue beyond surfaces, or return from different depths."""
        glass = any(m.transparent == "pass" for m in self.survey.materials)
        return glass or self.has_mirrors or self.leafy or self.porous

    @property
    def porous(self) -> bool:
        """Whether surfaces have gaps, or return light from different depths."""
        return any(m.is_porous for m in self.survey.materials)

    @property
    def has_reflectance_spread(self) -> bool:
        """Whether the reflectance of surfaces varies from sub-ray to sub-ray."""
        return any(m.reflectance_spread > 0 for m in self.survey.materials)

    @property
    def has_mirrors(self) -> bool:
        """Whether surfaces reflect light specularly."""
        return self.survey.wet > 0 or any(m.specular for m in self.survey.materials)

    @property
    def refracts(self) -> bool:
        """Whether any medium refracts light."""
        return any(m.refractive_index is not None for m in self.survey.materials)

    @property
    def in_waveforms(self) -> bool:
        """Whether the receiver detects returns in waveforms."""
        return self.reporting.waveform != "none"

    @property
    def waveform_samples(self) -> int:
        """Number of samples in the recorded waveform of each return."""
        return self.survey.waveform_samples

    @property
    def return_count_varies(self) -> bool:
        """Whether a ray that hits a surface may have several returns, none, or a random energy."""
        if self.is_recorded or self.has_role(Role.CHANGES | Role.RECEIVES):
            return True
        dark = any(material.reflectance == 0 for material in self.survey.materials)
        return (
            self.reporting.subrays > 1
            or self.has_onward_light
            or self.has_reflectance_spread
            or dark
            or self.noise.loses_returns
        )

    @property
    def has_received_returns(self) -> bool:
        """Whether the receiver adds or merges returns of a pulse before the selection."""
        return self.has_role(Role.RECEIVES)

    def has_role(self, roles: Role) -> bool:
        """Return whether any step that applies has one of the roles.

        Raises
        ------
        RuntimeError
            If the steps have not been chosen yet.
        """
        if self.roles is None:
            raise RuntimeError("only a step with Role.FRAME may depend on which other steps apply")
        return bool(self.roles & roles)

    def faults(self, *kinds: FaultKind) -> dict[int, Fault]:
        """Return the sensor's faults of the given kinds, keyed by their number in the survey."""
        return self.survey.sensor_faults(self.number, *kinds)


class Sizes(NamedTuple):
    """Numbers of rays and returns in memory if all rays hit a surface."""

    rays: int  # rays of all scans whose memory is estimated
    beams: float  # beams of one `PulseBatch`
    subrays: int  # sub-rays of one `PulseBatch`
    return_count: float  # returns of all `rays`
    points: float  # returns that become points, which are every n-th (`Survey.keep_every`)


class Memory(NamedTuple):
    """Peak memory of casting, in bytes."""

    retained: float = 0.0  # from the step until columns are computed from the returns
    casting: float = 0.0  # while the beams of a `PulseBatch` are cast
    # after all beams are cast, while returns are counted and thinned out
    counting: float = 0.0


@dataclass(frozen=True, eq=False)
class RecordedPulses:
    """Pulses of a recorded sweep and their returns.

    Attributes
    ----------
    ray
        (n,): rays of the returns in ascending order, counted from the first ray of the sweep.
    distance
        (n,): ranges of the returns in meters, in ascending order for each ray.
    energy
        (n,): energies of the returns on the scale of `SceneSurfaces.energy`. They must not be far
        below the detection threshold of the sensor, because the returns were detected.
    fired
        (rays,): whether each ray of the sweep was fired. Rays that were not fired fill gaps in the
        grid of firings and channels.
    """

    ray: Ints
    distance: Floats
    energy: Floats
    fired: Bools


class Emitter:
    """Division of a sensor's beams into sub-rays."""

    def __init__(self, setup: Setup) -> None:
        self.beam = setup.reporting.beam(setup.sensor.optics)
        carried = setup.survey.mounted_sensors[setup.number]
        # Rotation axis of the head in the platform frame. The sub-rays of an oval beam are spread
        # perpendicular to the axis and along it.
        axis = rotate(np.array([[0.0, 0, 1]]), setup.sensor.axes)
        self._axis = rotate(axis, carried.mount.rotation)[0]
        self._about_axis = self.beam.oval or setup.has_role(Role.ABOUT_AXIS)

    def __len__(self) -> int:
        """Return the number of sub-rays per beam."""
        return len(self.beam)

    def subrays_of(
        self,
        pattern: Pattern,
        offsets: Floats | None = None,
        beam_indices: Ints | None = None,
        *,
        by_head: bool = False,
    ) -> Pattern:
        """Return the sub-rays of the given beams.

        Parameters
        ----------
        pattern
            Central rays of the beams.
        offsets
            (n, 2): angles in radians that are added to the directions of the n beams
            (`PulseBatch.deflect`).
        beam_indices
            (n,): rows of `pattern` that are divided, by default all.
        by_head
            Whether the beams are in the head frame instead of the platform frame.
        """
        if len(self) == 1 and offsets is None:
            return pattern
        axis = np.array([0.0, 0, 1]) if by_head else self._axis
        sub_rays = SubRays(self.beam.angles, self.beam.starts, axis if self._about_axis else None)
        return pattern.with_sub_rays(sub_rays, offsets, beam_indices)


@dataclass(eq=False)
class PulseBatch:
    """Consecutive rays that are cast together, and data that steps pass to later steps.

    `PulseCaster.scan` divides the rays of its scans into such batches. A beam is a ray of the
    scans, numbered from 0 at the first scan. A batch has the beams `start` to `stop`.
    """

    keys: Keys  # scan and ray numbers of all beams of the scans, for random numbers
    start: int  # number of the batch's first beam
    stop: int  # one past the batch's last beam
    # rays of beams in the head or platform frame, or a function that returns them
    pattern: Pattern | Callable[[], Pattern]
    first: int  # row of beam 0 in the pattern, which repeats
    poses: CastPoses  # poses of all beams of the scans
    firings: Firings  # firings of all beams of the scans
    emitter: Emitter
    recorded: RecordedPulses | None = None  # recorded pulses of all beams; None if rays are cast
    # (stop - start, 2): angles in radians added to the directions of beams (`deflect`)
    offsets: Floats | None = None
    # Hits of sub-rays on surfaces and, with waveforms, in the air, sorted by sub-ray. Sub-rays are
    # numbered from 0 at the start of the batch.
    hits: PulseReturns | None = None
    planes: Planes | None = None  # planes of `hits`; None if beams have a single sub-ray
    air: PulseReturns | None = None  # hits in the air that are not among `hits`

    def deflect(self, offsets: Floats) -> None:
        """Add angles to the directions of the batch's beams before casting.

        The angles have shape (n, 2) and are in radians. With `Role.ABOUT_AXIS`, they are azimuth
        and elevation, otherwise horizontal and vertical.
        """
        earlier = np.zeros((self.stop - self.start, 2)) if self.offsets is None else self.offsets
        self.offsets = earlier + offsets

    def select(self, row_indices: Indices) -> PulseReturns:
        """Keep only the selected rows of `hits` and `planes`. Return the remaining hits."""
        assert self.hits is not None
        self.hits = self.hits.take(row_indices)
        if self.planes is not None:
            normals, directions = self.planes
            self.planes = normals[row_indices], directions[row_indices]
        return self.hits

    @property
    def subrays_per_beam(self) -> int:
        """Number of sub-rays per beam."""
        return len(self.emitter)

    @cached_property
    def beams(self) -> Pattern:
        """Sub-rays of the batch's beams or, if no beam is deflected, of all rays in the pattern.

        `window` has the batch's rows in this pattern. If no beam is deflected, batches share the
        pattern, so it is not sliced.
        """
        beam_indices = np.arange(self.first + self.start, self.first + self.stop)
        pattern_rows = None if self.offsets is None else beam_indices
        pattern = self.pattern() if callable(self.pattern) else self.pattern
        return self.emitter.subrays_of(
            pattern, self.offsets, pattern_rows, by_head=self.poses.by_head
        )

    @property
    def row_range(self) -> slice:
        """Rows of `firings` that belong to the batch, which consists of complete firings."""
        channels = self.firings.sensor.channels
        return slice(self.start // channels, self.stop // channels)

    @property
    def window(self) -> tuple[int, int]:
        """Range of rows in `beams` with the batch's sub-rays, as start and stop.

        The rows repeat, so the range may exceed their number.
        """
        row = 0 if self.offsets is not None else (self.first + self.start) * self.subrays_per_beam
        return row, row + (self.stop - self.start) * self.subrays_per_beam

    @cached_property
    def subray_poses(self) -> CastPoses:
        """Poses of the batch's sub-rays. The first sub-ray of the batch has number 0."""
        return self.poses.for_subrays(self.start, self.stop, self.subrays_per_beam)

    @cached_property
    def central_rays(self) -> tuple[Floats, Floats]:
        """Origins (in meters) and directions of the beams' central sub-rays.

        The shape is (n, 3). The central sub-ray is the first of each beam. Both arrays are in the
        scene frame.
        """
        subray_indices = np.arange(self.stop - self.start) * self.subrays_per_beam
        origins, directions = self.subray_poses.rays(self.beams, subray_indices, self.window[0])
        return np.broadcast_to(origins, directions.shape), directions


class PulseStep(ABC):
    """A single effect on the pulses of a sensor.

    Defining a subclass without a `role` raises a TypeError, because the role decides how rays are
    cast.
    """

    role: ClassVar[Role]
    effects: ClassVar[tuple[str, ...]] = ()  # sections of docs/effects.md that describe the step
    reads: ClassVar[tuple[str, ...]] = ()  # fields of `PulseReturns` that the step reads
    writes: ClassVar[tuple[str, ...]] = ()  # fields that the step adds or changes
    causes: ClassVar[tuple[int, ...]] = ()  # values of `cause` for returns that the step adds
    purposes: ClassVar[tuple[Purpose, ...]] = ()  # purposes of the step's random numbers
    # Sentences that state why the step cannot act on recorded pulses, and what to do instead. Empty
    # if the step can act on recorded pulses.
    on_recordings: ClassVar[str] = ""

    def __init_subclass__(cls) -> None:
        if not getattr(cls, "role", None):
            raise TypeError(f"step {cls.__name__} has no role. Set `role` to flags of `Role`")

    def __init__(self, setup: Setup, caster: SceneCaster, surfaces: SceneSurfaces) -> None:
        self.setup = setup
        self.caster = caster
        self.surfaces = surfaces

    def with_moved_instances(self, setup: Setup, surfaces: SceneSurfaces) -> PulseStep:
        """Return a copy of the step for a scene in which instances have moved.

        By default, a new step is created. A step that takes long to create and stores no surface
        positions returns `with_setup` instead.
        """
        return type(self)(setup, self.caster, surfaces)

    def with_setup(self, setup: Setup, surfaces: SceneSurfaces) -> Self:
        """Return a copy of the step with a new setup and new surfaces."""
        step = copy(self)
        step.setup = setup
        step.surfaces = surfaces
        return step

    @staticmethod
    @abstractmethod
    def applies(setup: Setup) -> bool:
        """Return whether the step acts on the sensor."""

    @staticmethod
    def added_returns(setup: Setup) -> float:
        """Return the mean number of returns that the step adds per pulse, or an upper bound."""
        return 0.0

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """Return the memory that the step requires, in bytes."""
        return Memory()

    @abstractmethod
    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Apply the step to the returns of a batch.

        Until `SeparationStep` or `WaveformStep` combines hits into returns, `returns` are the hits
        of sub-rays, and `ray` has sub-ray numbers. A step that changes hits must also assign the
        result to `batch.hits`. To select hits, it must use `batch.select`.
        """
