"""What a step of the simulation is: one effect, which changes the returns of some pulses.

`steps.py` has the list of steps. Each is a class that says when it applies, what it reads and
writes, which random numbers are its own, and how much memory it takes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np

from raybeam import Pattern, SubRays

from ..base.arrays import Floats, Ints
from ..base.vectors import turned
from ..columns.table import VELOCITY
from ..scene.scene import Scene
from ..sensor import Fault, Noise, Returns, Sensor, Survey
from ..sensor.faults import FaultKind
from ..sensor.noise import Purpose
from .motion import Firings, Poses
from .returns import Keys, Planes, PulseReturns
from .scene_caster import SceneCaster
from .surfaces import Surfaces


@dataclass(frozen=True, eq=False)
class Setup:
    """One sensor of a survey in a scene: what steps are chosen by."""

    scene: Scene
    survey: Survey
    number: int  # of the sensor

    @property
    def sensor(self) -> Sensor:
        """The sensor."""
        return self.survey.carried[self.number].sensor

    @property
    def noise(self) -> Noise:
        """Its noise."""
        return self.survey.noise_each[self.number]

    @property
    def reporting(self) -> Returns:
        """Its beam, and which returns it reports."""
        return self.survey.returns_each[self.number]

    @property
    def gap_m(self) -> float:
        """Half of its pulse's length, metres."""
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
        """Whether light goes on behind a surface, or off it."""
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
        noise, reporting = self.noise, self.reporting
        dark = any(m.reflectance == 0 for m in self.survey.materials)
        beam = reporting.subrays > 1 or self.in_waveforms or self.recorded > 0
        lost = bool(self.faults("dirt", "dead_channels", "dropped_packets", "frozen"))
        return beam or lost or noise.loses or self.passing or dark

    @property
    def receives_more(self) -> bool:
        """Whether the receiver adds to the returns of a pulse or joins some, before it selects."""
        noise = self.noise
        adds = noise.false_alarm_hz or noise.stray_light or noise.crosstalk
        return bool(adds or noise.saturation)

    def faults(self, *kinds: FaultKind) -> dict[int, Fault]:
        """Return the faults of some kinds of the sensor, see `Survey.faults_of`."""
        return self.survey.faults_of(self.number, *kinds)


class Sizes(NamedTuple):
    """How many there are of what takes memory, if all rays hit something."""

    rays: int
    beams: float  # that are cast at a time
    subrays: int  # and sub-rays of them
    returns: float  # of all rays
    points: float  # of these, that are kept


class Memory(NamedTuple):
    """Bytes that casting takes."""

    kept: float = 0.0  # until columns are made
    casting: float = 0.0  # while some beams are cast
    counting: float = 0.0  # and then, while all returns are counted and thinned out


class Emitter:
    """Gives beams of a sensor their sub-rays."""

    def __init__(self, setup: Setup) -> None:
        self.beam = setup.reporting.beam(setup.sensor.optics)
        carried = setup.survey.carried[setup.number]
        # The axis that the head turns about, in the carrier's axes: of an oval beam, sub-rays lie
        # across it and towards it.
        axis = turned(np.array([[0.0, 0, 1]]), setup.sensor.axes)
        self._axis = turned(axis, carried.mount.rotation)[0]
        self._about_axis = self.beam.oval or setup.noise.ripple_deg > 0

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
        """Give beams sub-rays, or those of some rows, with offsets of their angles, radians.

        `by_head` says that they are in the axes of the head, and not in those of the carrier.
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
    start: int  # number of the first beam, counted as the keys' are
    stop: int
    pattern: Pattern  # of the beams
    first: int  # row of the first of them in it
    poses: Poses  # of all beams of the keys
    firings: Firings  # of these
    emitter: Emitter
    offsets: Floats | None = None  # of the beams' angles, (n, 2), radians
    hits: PulseReturns | None = None  # of all sub-rays
    planes: Planes | None = None  # of these
    air: PulseReturns | None = None  # hits in the air, which are not among them

    @property
    def each(self) -> int:
        """Sub-rays of a beam."""
        return len(self.emitter)

    @cached_property
    def beams(self) -> Pattern:
        """Sub-rays of the beams, and maybe those of others."""
        rows = np.arange(self.first + self.start, self.first + self.stop)
        some = None if self.offsets is None else rows
        return self.emitter.divided(self.pattern, self.offsets, some, by_head=self.poses.by_head)

    @property
    def rows(self) -> slice:
        """Rows of the beams' firings; a batch begins and ends with one."""
        each = self.firings.sensor.channels
        return slice(self.start // each, self.stop // each)

    @property
    def window(self) -> tuple[int, int]:
        """The first of the sub-rays in `beams`, and behind the last."""
        row = 0 if self.offsets is not None else (self.first + self.start) * self.each
        return row, row + (self.stop - self.start) * self.each

    @cached_property
    def here(self) -> Poses:
        """Poses of the sub-rays."""
        return self.poses.part(self.start, self.stop, self.each)

    @cached_property
    def middles(self) -> tuple[Floats, Floats]:
        """Origins and directions (n, 3) of the rays in the middles of the beams."""
        rows = np.arange(self.stop - self.start) * self.each
        origins, directions = self.here.rays(self.beams, rows, self.window[0])
        return np.broadcast_to(origins, directions.shape), directions


class PulseStep(ABC):
    """An effect on pulses. It is made where it applies, and then applied to batch after batch."""

    effects: ClassVar[tuple[str, ...]] = ()  # sections of docs/effects.md about it
    reads: ClassVar[tuple[str, ...]] = ()  # columns of returns
    writes: ClassVar[tuple[str, ...]] = ()
    purposes: ClassVar[tuple[Purpose, ...]] = ()  # of its random numbers
    of_kept: ClassVar[bool] = False  # whether it works on the returns that are kept, batch by batch

    def __init__(self, setup: Setup, caster: SceneCaster, surfaces: Surfaces) -> None:
        self.setup, self.caster, self.surfaces = setup, caster, surfaces

    @staticmethod
    @abstractmethod
    def applies(setup: Setup) -> bool:
        """Whether it is there; else it costs nothing and changes no byte."""

    @staticmethod
    def added(setup: Setup) -> float:
        """Count the returns that it adds to those of a pulse, on average."""
        return 0.0

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """Memory that it takes."""
        return Memory()

    @abstractmethod
    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Return the returns as they are after it."""
