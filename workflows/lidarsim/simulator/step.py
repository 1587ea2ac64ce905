"""Steps of the simulation: a step is one effect on the pulses of a sensor.

`steps.py` lists the steps in their order. A step is a class that declares its role, when it
applies, the columns that it reads and writes, its random numbers and its memory. Nothing else
decides whether a step acts: how rays are cast follows from the roles of the steps that apply.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import Flag, auto
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np

from raybeam import Pattern, SubRays

from ..base.arrays import Floats, Indices, Ints
from ..base.vectors import turned
from ..columns.table import VELOCITY
from ..scene.scene import Scene
from ..sensor import Fault, Noise, Returns, Sensor, Survey
from ..sensor.faults import FaultKind
from ..sensor.random_numbers import Purpose
from .motion import CastPoses, Firings
from .returns import Keys, Planes, PulseReturns
from .scene_caster import SceneCaster
from .surfaces import Surfaces


class Role(Flag):
    """What a step does to pulses; each step declares at least one flag."""

    AIMS = auto()  # turns beams before they are cast
    ABOUT_AXIS = auto()  # turns them in azimuth and elevation of the head, not in any two axes
    CHANGES = auto()  # a ray may then have no return, several, another energy or a waveform
    RECEIVES = auto()  # likewise, by returns that the receiver adds or joins before it selects
    OF_KEPT = auto()  # acts on the returns that are kept, of all batches together
    FRAME = auto()  # casts rays, makes returns of hits or selects returns, for the other steps


@dataclass(frozen=True, eq=False)
class Setup:
    """One sensor of a survey in a scene, by which steps are chosen."""

    scene: Scene
    survey: Survey
    number: int  # of the sensor
    # Roles of all steps that apply, but for `Role.FRAME`; None while these steps are chosen.
    roles: Role | None

    @property
    def sensor(self) -> Sensor:
        """The sensor."""
        return self.survey.carried[self.number].sensor

    @property
    def noise(self) -> Noise:
        """Noise of the sensor."""
        return self.survey.noise_each[self.number]

    @property
    def reporting(self) -> Returns:
        """Beam of the sensor, and which returns are reported."""
        return self.survey.returns_each[self.number]

    @property
    def gap_m(self) -> float:
        """Half of the pulse's length, metres."""
        return self.reporting.of(self.sensor.optics)[1]

    @property
    def moving(self) -> bool:
        """Whether returns have radial velocities."""
        return any(column.name == VELOCITY for column in self.survey.stored_columns)

    @property
    def leafy(self) -> bool:
        """Whether anything is full of leaves."""
        leaves = any(m.leaf_area_density is not None for m in self.survey.materials)
        return leaves or bool(self.scene.has_voxels.any())

    @property
    def passing(self) -> bool:
        """Whether light goes on through surfaces or off surfaces."""
        glass = any(m.transparent == "pass" for m in self.survey.materials)
        return glass or self.mirroring or self.leafy

    @property
    def mirroring(self) -> bool:
        """Whether surfaces mirror light."""
        return self.survey.wet > 0 or any(m.specular for m in self.survey.materials)

    @property
    def refracting(self) -> bool:
        """Whether light is refracted."""
        return any(m.refractive_index is not None for m in self.survey.materials)

    @property
    def in_waveforms(self) -> bool:
        """Whether returns are found in waveforms."""
        return self.reporting.waveform != "none"

    @property
    def recorded(self) -> int:
        """Samples of the recorded waveform of each return."""
        return self.survey.waveform_samples

    @property
    def several(self) -> bool:
        """Whether a ray that hits something may have no return, or several; else it has one."""
        if self.has(Role.CHANGES | Role.RECEIVES):
            return True
        dark = any(material.reflectance == 0 for material in self.survey.materials)
        return self.reporting.subrays > 1 or self.passing or dark or self.noise.loses

    @property
    def receives_more(self) -> bool:
        """Whether the receiver adds to the returns of a pulse or joins some, before it selects."""
        return self.has(Role.RECEIVES)

    def has(self, roles: Role) -> bool:
        """Return whether a step that applies has one of some roles.

        Raises
        ------
        RuntimeError
            If the steps are not chosen yet.
        """
        if self.roles is None:
            raise RuntimeError("only a step of Role.FRAME may apply because others do")
        return bool(self.roles & roles)

    def faults(self, *kinds: FaultKind) -> dict[int, Fault]:
        """Return the faults of some kinds of the sensor, see `Survey.faults_of`."""
        return self.survey.faults_of(self.number, *kinds)


class Sizes(NamedTuple):
    """Numbers of what takes memory, if all rays hit something."""

    rays: int
    beams: float  # cast at a time
    subrays: int  # of the beams that are cast at a time
    returns: float  # of all rays
    points: float  # returns that are kept


class Memory(NamedTuple):
    """Peak memory of casting, in bytes."""

    retained: float = 0.0  # until columns are made
    casting: float = 0.0  # while some beams are cast
    counting: float = 0.0  # then, while all returns are counted and thinned out


class Emitter:
    """Divides the beams of a sensor into sub-rays."""

    def __init__(self, setup: Setup) -> None:
        self.beam = setup.reporting.beam(setup.sensor.optics)
        carried = setup.survey.carried[setup.number]
        # The axis that the head turns about, in the carrier's axes: of an oval beam, sub-rays lie
        # across it and towards it.
        axis = turned(np.array([[0.0, 0, 1]]), setup.sensor.axes)
        self._axis = turned(axis, carried.mount.rotation)[0]
        self._about_axis = self.beam.oval or setup.has(Role.ABOUT_AXIS)

    def __len__(self) -> int:
        return len(self.beam)

    def divided(
        self,
        pattern: Pattern,
        offsets: Floats | None = None,
        rows: Ints | None = None,
        *,
        by_head: bool = False,
    ) -> Pattern:
        """Return the sub-rays of beams, or of some rows, with offsets of angles, radians.

        `by_head` says that the beams are in the axes of the head, not in those of the carrier.
        """
        if len(self) == 1 and offsets is None:
            return pattern
        axis = np.array([0.0, 0, 1]) if by_head else self._axis
        sub_rays = SubRays(self.beam.angles, self.beam.starts, axis if self._about_axis else None)
        return pattern.divided(sub_rays, offsets, rows)


@dataclass(eq=False)
class PulseBatch:
    """Consecutive beams, and what steps leave for later ones."""

    keys: Keys
    start: int  # number of the first beam, counted as in the keys
    stop: int  # one past the last
    pattern: Pattern  # rays of beams
    first: int  # row of the beam with number 0 in the pattern
    poses: CastPoses  # of all beams of the keys
    firings: Firings  # of all beams of the keys
    emitter: Emitter
    offsets: Floats | None = None  # of the beams' angles, (n, 2), radians
    hits: PulseReturns | None = None  # of all sub-rays with surfaces
    planes: Planes | None = None  # of `hits`
    air: PulseReturns | None = None  # hits in the air, which are not among `hits`

    def deflect(self, offsets: Floats) -> None:
        """Add angles to the directions of the beams before they are cast, (n, 2), radians.

        With `Role.ABOUT_AXIS` these are angles of azimuth and elevation, else across and up.
        """
        before = np.zeros((self.stop - self.start, 2)) if self.offsets is None else self.offsets
        self.offsets = before + offsets

    def select(self, rows: Indices) -> PulseReturns:
        """Leave some of the hits of sub-rays, and their planes; returns the hits that are left."""
        assert self.hits is not None
        self.hits = self.hits.take(rows)
        if self.planes is not None:
            normals, directions = self.planes
            self.planes = normals[rows], directions[rows]
        return self.hits

    @property
    def subrays_per_beam(self) -> int:
        """Sub-rays of a beam."""
        return len(self.emitter)

    @cached_property
    def beams(self) -> Pattern:
        """Sub-rays of the beams, and maybe of other beams."""
        rows = np.arange(self.first + self.start, self.first + self.stop)
        some = None if self.offsets is None else rows
        return self.emitter.divided(self.pattern, self.offsets, some, by_head=self.poses.by_head)

    @property
    def rows(self) -> slice:
        """Rows of the beams' firings; a batch begins and ends with a firing."""
        each = self.firings.sensor.channels
        return slice(self.start // each, self.stop // each)

    @property
    def window(self) -> tuple[int, int]:
        """First row of the sub-rays in `beams`, and one past the last."""
        row = 0 if self.offsets is not None else (self.first + self.start) * self.subrays_per_beam
        return row, row + (self.stop - self.start) * self.subrays_per_beam

    @cached_property
    def subray_poses(self) -> CastPoses:
        """Poses of the sub-rays."""
        return self.poses.part(self.start, self.stop, self.subrays_per_beam)

    @cached_property
    def middles(self) -> tuple[Floats, Floats]:
        """Origins and directions (n, 3) of the rays in the middles of the beams."""
        rows = np.arange(self.stop - self.start) * self.subrays_per_beam
        origins, directions = self.subray_poses.rays(self.beams, rows, self.window[0])
        return np.broadcast_to(origins, directions.shape), directions


class PulseStep(ABC):
    """An effect on pulses, made once for each sensor to which it applies.

    A subclass without a `role` is a TypeError: nothing would know when to apply the step.
    """

    role: ClassVar[Role]
    effects: ClassVar[tuple[str, ...]] = ()  # sections of docs/effects.md about it
    reads: ClassVar[tuple[str, ...]] = ()  # columns of returns
    writes: ClassVar[tuple[str, ...]] = ()
    causes: ClassVar[tuple[int, ...]] = ()  # values of `cause` of the returns that the step adds
    purposes: ClassVar[tuple[Purpose, ...]] = ()  # of the random numbers of the step

    def __init_subclass__(cls) -> None:
        if not getattr(cls, "role", None):
            raise TypeError(f"step {cls.__name__} states no role: set `role` to flags of `Role`")

    def __init__(self, setup: Setup, caster: SceneCaster, surfaces: Surfaces) -> None:
        self.setup = setup
        self.caster = caster
        self.surfaces = surfaces

    @staticmethod
    @abstractmethod
    def applies(setup: Setup) -> bool:
        """Return whether the step acts on a sensor; else it costs nothing and changes no byte."""

    @staticmethod
    def added(setup: Setup) -> float:
        """Return how many returns the step adds to a pulse, on average."""
        return 0.0

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """Return the memory that the step takes, in bytes."""
        return Memory()

    @abstractmethod
    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Return the returns of a batch as they are after the step.

        Before returns are made of hits, these are the hits of sub-rays. A step that changes the
        hits assigns them to `batch.hits` as well, and selects some by `batch.select`.
        """
