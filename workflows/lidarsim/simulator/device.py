"""Columns that are made on the CUDA device: only kept values cross the bus, in the types of files.

The formulas are those of `BatchPoints`, with the same bits. If a survey has other columns too, its
kept hits cross the bus as well, and NumPy makes those: energies in haze, azimuths and noise, since
`exp` and `atan2` of a device differ from those of `elementary` in the last bit. So it does with the
energies of hits on actors, for which it needs their poses; `SceneCaster` finds these hits,
and the device merges them with its own.
"""

from __future__ import annotations

import importlib.resources
from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from raybeam import DeviceHits, Outbox, Pattern, check_scan
from raybeam.device import to_device

from ..base.arrays import AnyArray, Floats, Indices, Ints
from ..columns.table import AXES, CHANNEL, OBJECT, TABLE, Column
from ..scene.scene import Scene
from ..sensor import ScanSpec, Survey
from ..sensor.materials import NEAREST_M, REFERENCE_M, RETRO_GAIN
from .motion import CastPoses
from .points import BatchPoints
from .pulses import Scanned
from .returns import SURFACE, PulseReturns
from .scene_caster import SceneCaster
from .surfaces import Surfaces

OPTIONS = "-std=c++17", "-fmad=false"  # of the compiler
_BLOCK = 128  # threads
_ENERGIES = "intensity", "reflectance"
_TRIANGLE = TABLE["triangle"]
# In the order of columns.cu.
_MADE = (
    *AXES, CHANNEL, OBJECT,
    *(TABLE[name] for name in ("ray", "time", "range", *_ENERGIES, "class")), _TRIANGLE,
)  # fmt: skip
_EQUAL = "sensor", "return_number", "returns", "cause"  # the same for all points
_HITS = np.uint32, np.float64, np.int32  # rays, distances and triangles of hits for NumPy
_NO_HITS = (np.zeros(0, np.int64), *(np.zeros(0, kind) for kind in _HITS))


def _able(scene: Scene, survey: Survey) -> set[str]:
    """Names of the columns that a device can make for a survey of a scene."""
    hazy = any(survey.extinction(carried.sensor) for carried in survey.carried)
    several = len({carried.sensor.optics.wavelength_nm for carried in survey.carried}) > 1
    shining = any(
        m.reflectance == "texture" or m.roughness is not None or (several and m.spectrum)
        for m in survey.materials
    )
    able = {column.name for column in _MADE} - {*(_ENERGIES if hazy or shining else ())}
    if scene.has_mixed_objects:  # of whose faces a device does not know the materials
        able -= {*_ENERGIES, "class"}
    able -= {"time"} if any(fault.by_s for fault in survey.faults) else set()
    return able - {axis.name for axis in AXES if survey.coordinates == "sensor"}


def needs_hits(scene: Scene, survey: Survey) -> bool:
    """Whether NumPy makes a column, so that all kept hits leave the device."""
    names = {column.name for column in survey.stored_columns}
    return not names <= _able(scene, survey) | {*_EQUAL}


@dataclass(frozen=True, eq=False)
class DevicePoints:
    """Columns of some consecutive scans of one station, see `BatchPoints`."""

    scene: Scene
    survey: Survey
    specs: list[ScanSpec]
    counts: Ints  # of each scan
    hits: Ints  # of each scan, kept or not
    tally: tuple[Indices, Ints]
    columns: dict[str, AnyArray]  # by name
    returns: BatchPoints | None  # on the host, if there are columns that NumPy makes

    def __len__(self) -> int:
        return int(self.counts.sum())

    def column(self, column: Column) -> AnyArray:
        """Values of a column."""
        if column.name in self.columns:
            return self.columns[column.name]
        if self.returns is not None:
            return column.make(self.returns)
        value = {"sensor": self.specs[0].sensor, "cause": SURFACE}.get(column.name, 1)
        return np.full(len(self), value, column.dtype)

    def ends(self, rows: Ints) -> Floats:
        """Positions of some points (k,), at least to the survey's precision: (k, 3)."""
        if self.returns is not None:
            return self.returns.ends(rows)
        cells = np.stack([self.columns[axis.name][rows] for axis in AXES], axis=1)
        return cells * self.survey.precision_m


class DeviceColumns:
    """Casts surveys whose rays have one return each, and makes their columns on the device."""

    def __init__(
        self, caster: SceneCaster, scene: Scene, survey: Survey, surfaces: Surfaces
    ) -> None:
        self._caster = caster
        self._scene = scene
        self._surfaces = surfaces
        self.survey = survey
        wanted = {column.name for column in survey.stored_columns}
        able = _able(scene, survey)
        self.all_hits = needs_hits(scene, survey)
        if self.all_hits and scene.actors:
            able -= {*_ENERGIES}
        self.made = [column for column in _MADE if column.name in wanted & able]
        self.energies = [column for column in self.made if column.name in _ENERGIES]
        # Whether NumPy needs hits on actors.
        self.some_hits = bool(scene.actors and self.energies)
        self.bodies, _ = surfaces.bodies()
        self._counters = caster.counters()
        self._sent: tuple[Any, ...] | None = None
        self._turns: Any = None

    def moved(self, scene: Scene, surfaces: Surfaces) -> DeviceColumns:
        """Return the same after instances have moved; what has not changed stays on the device."""
        made = copy(self)
        made._scene = scene
        made._surfaces = surfaces
        made._turns = None
        return made

    def returns(
        self,
        specs: list[ScanSpec],
        pattern: Pattern,
        poses: CastPoses,
        window: tuple[int, int],
        groups: Ints,
    ) -> DevicePoints:
        """Cast scans, see `Rig.returns`."""
        survey = self.survey
        sensor = self.survey.carried[specs[0].sensor].sensor
        every = survey.keep_every
        reach = (sensor.min_range_m, sensor.max_range_m)
        scan = check_scan(
            pattern, **poses.given, window=window, t_min=reach[0], t_max=reach[1],
            keep_every=every, groups=groups, tally=True,
        )  # fmt: skip
        others = self._caster.on_actors(scan, poses) if poses.ways else None
        if others is not None:  # rows of the actors' body
            others = replace(others, triangle=others.triangle - np.int32(self.bodies[-1, 0]))
        making = _Making(self, specs, groups, most=-(-len(scan) // every) + len(groups))
        try:
            hits, tally = self._caster.caster.visit(scan, making.make, self._counters, others)
        finally:  # else the device would write to memory that goes back to the pool
            columns, (ray, distance, triangle) = making.done()
        assert tally is not None
        found = Scanned(PulseReturns.single_returns(ray, distance, triangle), hits, None)
        returns = BatchPoints(
            self._scene, survey, self._surfaces, specs, found, pattern, window[0], poses
        )
        if self.some_hits:
            for column in self.energies:
                columns[column.name][making.rows] = column.make(returns)
        counts = -(-hits // every)
        on_host = returns if self.all_hits else None
        return DevicePoints(self._scene, survey, specs, counts, hits, tally, columns, on_host)

    def tables(self, cupy: Any) -> tuple[Any, ...]:
        """Tables of the surfaces for columns.cu, on the caster's device; see there."""
        if self._sent is None:
            surfaces = self._surfaces
            materials = self._surfaces.materials
            normals = surfaces.unit_normals if self.energies else np.zeros((1, 3), np.float32)
            tables = (
                self.bodies, surfaces.owners, normals, materials.reflectance,
                materials.retro.astype(np.uint8), materials.semantic_class,
            )  # fmt: skip
            self._sent = tuple(to_device(cupy, table) for table in tables)
        if self._turns is None:
            self._turns = to_device(cupy, self._surfaces.bodies()[1])
        return *self._sent, self._turns


class _Making:
    """Columns of a batch on their way from the device to the host."""

    def __init__(
        self, maker: DeviceColumns, specs: list[ScanSpec], groups: Ints, most: int
    ) -> None:
        self._maker = maker
        self._specs = specs
        self._groups = groups
        self._most = most
        self._begun: _Begun | None = None
        self._count = 0
        self._on_actors: list[tuple[AnyArray, ...]] = [_NO_HITS]  # rows, and as `_HITS`

    def make(self, hits: DeviceHits) -> None:
        """Make the columns of some hits, and send them to the host."""
        if not len(hits):
            return
        begun = self._begun = self._begun or self._begin(hits.cupy)
        cp = hits.cupy
        count = np.int64(len(hits))
        asked = {*begun.out, *([_TRIANGLE] if begun.hits else [])}
        made = {c: cp.empty(len(hits) if c in asked else 1, c.dtype) for c in _MADE}
        wanted = np.int32(sum(1 << _MADE.index(column) for column in asked))
        found = hits.ray, hits.distance, hits.triangle, hits.instance, *hits.rays(), count
        given = (*found, wanted, *begun.given, *made.values())
        begun.kernel((-(-len(hits) // _BLOCK),), (_BLOCK,), given)
        rows = slice(self._count, self._count + len(hits))
        pairs = [(made[column], out[rows]) for column, out in begun.out.items()]
        raw = hits.ray, hits.distance, made[_TRIANGLE]
        pairs += [(array, out[rows]) for array, out in zip(raw, begun.hits, strict=False)]
        begun.outbox.send(pairs)
        if self._maker.some_hits:
            on = cp.flatnonzero(hits.instance == len(self._maker.bodies) - 1)
            some = (on, hits.ray[on], hits.distance[on], hits.triangle[on])
            at, ray, distance, triangle = (array.get() for array in some)
            triangle += np.int32(self._maker.bodies[-1, 0])
            self._on_actors.append((self._count + at, ray, distance, triangle))
        self._count += len(hits)

    @property
    def rows(self) -> Ints:
        """Rows of the hits on actors."""
        return np.concatenate([rows for rows, *_ in self._on_actors])

    def done(self) -> tuple[dict[str, AnyArray], tuple[AnyArray, ...]]:
        """Wait for all columns; returns them by name, and what NumPy needs of hits, as `_HITS`."""
        if self._begun is None:
            return {c.name: np.zeros(0, c.dtype) for c in self._maker.made}, _NO_HITS[1:]
        self._begun.outbox.wait()
        # Page-locked memory has room for hits of all rays: where few hit, it is given back.
        few = 2 * self._count < self._most

        def kept(out: AnyArray) -> AnyArray:
            return out[: self._count].copy() if few else out[: self._count]

        columns = {column.name: kept(out) for column, out in self._begun.out.items()}
        if self._begun.hits:
            return columns, tuple(map(kept, self._begun.hits))
        _, *hits = map(np.concatenate, zip(*self._on_actors, strict=True))
        return columns, tuple(hits)

    def _begin(self, cupy: Any) -> _Begun:
        """Send what the kernel reads besides hits."""
        maker = self._maker
        specs = self._specs
        survey = maker.survey
        sensor = maker.survey.carried[specs[0].sensor].sensor
        bodies, owners, normals, reflectance, retro, classes, turns = maker.tables(cupy)
        firings = np.arange(specs[0].firings[0], specs[-1].firings[1], dtype=np.int64)
        outbox = Outbox(cupy)
        given = (
            np.float64(survey.precision_m),
            cupy.asarray(self._groups), np.int32(len(specs)),
            cupy.asarray(sensor.begins_ns(firings)), cupy.asarray(sensor.beams.time_ns),
            np.int32(sensor.channels), np.int64(specs[0].start_ns),
            bodies, owners, normals, turns,
            reflectance, retro, np.float64(RETRO_GAIN), np.float64(REFERENCE_M),
            np.float64(NEAREST_M), classes,
        )  # fmt: skip
        out = {column: outbox.room(self._most, column.dtype) for column in maker.made}
        hits = [outbox.room(self._most, kind) for kind in _HITS] if maker.all_hits else []
        return _Begun(_kernel(cupy, cupy.cuda.Device().id), given, outbox, out, hits)


@dataclass(frozen=True, eq=False)
class _Begun:
    """What a batch needs from its first hits on."""

    kernel: Any
    given: tuple[Any, ...]  # arguments between hits and columns
    outbox: Outbox
    out: dict[Column, AnyArray]  # page-locked, as all of these
    hits: list[AnyArray]  # as `_HITS`, if NumPy needs all of them


@lru_cache(maxsize=16)
def _kernel(cupy: Any, device: int) -> Any:
    """Compile columns.cu for the current device, whose number is `device`, once."""
    code = importlib.resources.files(__package__).joinpath("columns.cu").read_text("utf-8")
    module = cupy.RawModule(code=f'#line 1 "columns.cu"\n{code}', options=OPTIONS)
    return module.get_function("columns")
