"""Columns that are made on the CUDA device: only kept values cross the bus, in the types of files.

The formulas are those of `BatchReturns`, with the same bits. A survey with a column that only NumPy
can make, sub-rays, noise, actors or haze takes the hits to the host instead.
"""

from __future__ import annotations

import importlib.resources
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from raybeam import DeviceHits, Outbox, Pattern, check_scan
from raybeam.device import to_device

from ..columns.table import AXES, CHANNEL, OBJECT, TABLE, Column
from ..scene.scene import Scene
from ..sensor import ScanSpec, Survey
from ..sensor.materials import NEAREST_M, REFERENCE_M, RETRO_GAIN
from .motion import Poses
from .surfaces import Surfaces
from .world import World

OPTIONS = "-std=c++17", "-fmad=false"  # of the compiler
_BLOCK = 128  # threads
_ENERGIES = ("intensity", "reflectivity")
# In the order of columns.cu.
_MADE = (*AXES, CHANNEL, OBJECT, *(TABLE[name] for name in (
    "ray", "time", "range", *_ENERGIES, "class", "triangle",
)))  # fmt: skip
_EQUAL = ("sensor", "return_number", "returns")  # the same for all points


@dataclass(frozen=True, eq=False)
class DeviceReturns:
    """Columns of some consecutive scans of one station, see `BatchReturns`."""

    survey: Survey
    specs: list[ScanSpec]
    counts: NDArray[np.int64]  # of each scan
    hits: NDArray[np.int64]  # of each scan, kept or not
    counted: tuple[NDArray[np.int64], NDArray[np.int64]]  # counters, and their hits
    columns: dict[str, NDArray[Any]]

    def __len__(self) -> int:
        return int(self.counts.sum())

    def column(self, column: Column) -> NDArray[Any]:
        """Values of a column."""
        made = self.columns.get(column.name)
        if made is not None:
            return made
        value = self.specs[0].sensor if column.name == "sensor" else 1
        return np.full(len(self), value, column.dtype)

    def ends(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Positions of some points (k,), to the survey's precision: (k, 3)."""
        cells = np.stack([self.columns[axis.name][rows] for axis in AXES], axis=1)
        return cells * self.survey.precision_m


class DeviceColumns:
    """Casts plain surveys and makes their columns on the device."""

    def __init__(self, world: World, survey: Survey, surfaces: Surfaces) -> None:
        self._world, self.survey, self._surfaces = world, survey, surfaces
        self.wanted = [column for column in _MADE if column in survey.stored_columns]
        self._sent: tuple[Any, ...] | None = None
        self._turns: Any = None

    def moved(self, surfaces: Surfaces) -> DeviceColumns:
        """Return the same after instances have moved; what has not changed stays on the device."""
        made = copy(self)
        made._surfaces, made._turns = surfaces, None
        return made

    @staticmethod
    def can_make(world: World, scene: Scene, survey: Survey) -> bool:
        """Whether all of a survey's columns are made on a device, given one return for each ray."""
        names = {column.name for column in survey.stored_columns}
        known = {*(column.name for column in _MADE), *_EQUAL}
        clear = not any(survey.extinction(carried.sensor) for carried in survey.carried)
        return (
            world.caster.on_device
            and not scene.actors
            and survey.coordinates == "world"
            and all(column in TABLE.values() for column in survey.stored_columns)
            and names <= known
            and (clear or not names & {*_ENERGIES})
        )

    def returns(
        self,
        specs: list[ScanSpec],
        pattern: Pattern,
        poses: Poses,
        window: tuple[int, int],
        groups: NDArray[np.int64],
    ) -> DeviceReturns:
        """Cast scans, see `Rig.returns`."""
        survey, sensor = self.survey, self.survey.carried[specs[0].sensor].sensor
        every = survey.keep_every
        scan = check_scan(
            pattern, **poses.given, window=window, t_min=sensor.min_range_m,
            t_max=sensor.max_range_m, keep_every=every, groups=groups, tally=True,
        )  # fmt: skip
        making = _Making(self, specs, groups, most=-(-len(scan) // every) + len(groups))
        try:
            hits, counted = self._world.caster.visit(scan, making.make, self._world.counters)
        finally:  # else the device would write to memory that goes back to the pool
            columns = making.done()
        assert counted is not None
        return DeviceReturns(survey, specs, -(-hits // every), hits, counted, columns)

    def tables(self, cupy: Any) -> tuple[Any, ...]:
        """Tables of the surfaces for columns.cu, on the caster's device; see there."""
        if self._sent is None:
            surfaces, materials = self._surfaces, self._surfaces.materials
            shines = any(column.name in _ENERGIES for column in self.wanted)
            normals = surfaces.unit_normals if shines else np.zeros((3, 1), np.float32)
            tables = (
                surfaces.bodies()[0], surfaces.owners, normals, materials.reflectance,
                materials.retro.astype(np.uint8), materials.semantic_class,
            )  # fmt: skip
            self._sent = tuple(to_device(cupy, table) for table in tables)
        if self._turns is None:
            self._turns = to_device(cupy, self._surfaces.bodies()[1])
        return *self._sent, self._turns


class _Making:
    """Columns of a batch on their way from the device to the host."""

    def __init__(
        self, maker: DeviceColumns, specs: list[ScanSpec], groups: NDArray[np.int64], most: int
    ) -> None:
        self._maker, self._specs, self._groups, self._most = maker, specs, groups, most
        self._begun: _Begun | None = None
        self._made = 0

    def make(self, hits: DeviceHits) -> None:
        """Make the columns of some hits, and send them to the host."""
        if not len(hits):
            return
        begun = self._begun = self._begun or self._begin(hits.cupy)
        cp, count = hits.cupy, np.int64(len(hits))
        made = {
            column: cp.empty(len(hits) if column in begun.out else 1, column.dtype)
            for column in _MADE
        }
        found = hits.ray, hits.distance, hits.triangle, hits.instance, *hits.rays(), count
        begun.kernel((-(-len(hits) // _BLOCK),), (_BLOCK,), (*found, *begun.given, *made.values()))
        rows = slice(self._made, self._made + len(hits))
        begun.outbox.send([(made[column], out[rows]) for column, out in begun.out.items()])
        self._made += len(hits)

    def done(self) -> dict[str, NDArray[Any]]:
        """Wait for all columns: {name: values}."""
        if self._begun is None:
            return {column.name: np.zeros(0, column.dtype) for column in self._maker.wanted}
        self._begun.outbox.wait()
        return {column.name: out[: self._made] for column, out in self._begun.out.items()}

    def _begin(self, cupy: Any) -> _Begun:
        """Send what the kernel reads besides hits."""
        maker, specs = self._maker, self._specs
        survey, sensor = maker.survey, maker.survey.carried[specs[0].sensor].sensor
        bodies, owners, normals, reflectance, retro, classes, turns = maker.tables(cupy)
        firings = np.arange(specs[0].firings[0], specs[-1].firings[1], dtype=np.int64)
        outbox = Outbox(cupy)
        given = (
            np.int32(sum(1 << _MADE.index(column) for column in maker.wanted)),
            np.float64(survey.precision_m),
            cupy.asarray(self._groups), np.int32(len(specs)),
            cupy.asarray(sensor.begins_ns(firings)), cupy.asarray(sensor.beams.time_ns),
            np.int32(sensor.channels), np.int64(specs[0].start_ns),
            bodies, owners, normals, np.int64(normals.shape[1]), turns,
            reflectance, retro, np.float64(RETRO_GAIN), np.float64(REFERENCE_M),
            np.float64(NEAREST_M), classes,
        )  # fmt: skip
        out = {column: outbox.room(self._most, column.dtype) for column in maker.wanted}
        return _Begun(_kernel(cupy, cupy.cuda.Device().id), given, outbox, out)


@dataclass(frozen=True, eq=False)
class _Begun:
    """What a batch needs from its first hits on."""

    kernel: Any
    given: tuple[Any, ...]  # arguments between hits and columns
    outbox: Outbox
    out: dict[Column, NDArray[Any]]  # page-locked


@lru_cache(maxsize=16)
def _kernel(cupy: Any, device: int) -> Any:
    """Compile columns.cu for the current device, whose number is `device`, once."""
    code = importlib.resources.files(__package__).joinpath("columns.cu").read_text("utf-8")
    module = cupy.RawModule(code=f'#line 1 "columns.cu"\n{code}', options=OPTIONS)
    return module.get_function("columns")
