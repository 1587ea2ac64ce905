"""Compute columns on a CUDA device, and transfer only their values in the file's data types.

Formulas and results are bit-identical to `BatchPoints`. If a survey has other columns, the reported
hits are transferred as well, and NumPy computes these columns. They include energies in haze,
azimuths and noise, because `exp` and `atan2` on a device differ from `elementary` in the last bit.
NumPy also computes the energies of sensors with intensity factors, and of hits on actors, which
depend on the actors' poses: `SceneCaster` finds the hits on actors, and the device merges them with
its own hits.
"""

from __future__ import annotations

import importlib.resources
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from raybeam import Pattern
from raybeam.device import (
    CopyQueue,
    DeviceHits,
    ExternalHits,
    pinned_array,
    to_device,
    trim_to_count,
)
from raybeam.scan import Scan, check_scan

from ...casting.motion import CastPoses
from ...casting.scene_caster import SceneCaster
from ...casting.surfaces import SceneSurfaces
from ...columns.actor_rays import NO_ACTOR_RAYS
from ...columns.table import AXES, CHANNEL, OBJECT, TABLE, Column
from ...media.materials import NEAREST_M, REFERENCE_M, RETRO_GAIN
from ...numerics.arrays import AnyArray, Floats, Floats32, Indices, Ints, Records
from ...pulses.pulses import ScannedReturns
from ...pulses.returns import SURFACE, PulseReturns
from ...scene.scene import Scene
from ...survey.survey import ScanSpec, Survey
from .batch_points import BatchPoints

OPTIONS = "-std=c++17", "-fmad=false"  # compiler options
_BLOCK = 128  # threads per block
_ENERGIES = "intensity", "reflectance"
_TRIANGLE = TABLE["triangle"]
# Columns that a device computes, in the order used in columns.cu.
_DEVICE_COLUMNS = (
    *AXES, CHANNEL, OBJECT,
    *(TABLE[name] for name in ("ray", "time", "range", *_ENERGIES, "class")), _TRIANGLE,
)  # fmt: skip
_CONSTANT_COLUMNS = "sensor", "return_number", "returns", "cause"  # same value for all points
_HITS = np.uint32, np.float64, np.int32  # types of rays, distances and triangles for NumPy
_NO_HITS = (np.zeros(0, np.int64), *(np.zeros(0, kind) for kind in _HITS))


def _device_column_names(scene: Scene, survey: Survey) -> set[str]:
    """Return the names of the columns that a device can compute for a survey in a scene."""
    hazy = any(survey.extinction(carried.sensor) for carried in survey.mounted_sensors)
    several_wavelengths = (
        len({carried.sensor.optics.simulated_nm for carried in survey.mounted_sensors}) > 1
    )
    textured_or_rough = any(
        m.reflectance == "texture"
        or m.roughness is not None
        or (several_wavelengths and m.spectrum)
        for m in survey.materials
    )
    has_factors = any(
        carried.sensor.beams.has_intensity_factors or carried.sensor.optics.incidence_exponent != 1
        for carried in survey.mounted_sensors
    )
    computable = {column.name for column in _DEVICE_COLUMNS} - {
        *(_ENERGIES if hazy or textured_or_rough or has_factors else ())
    }
    if scene.has_mixed_objects:  # the device does not know the materials of faces
        computable -= {*_ENERGIES, "class"}
    computable -= {"time"} if any(fault.by_s for fault in survey.faults) else set()
    on_host = survey.coordinates == "sensor" or survey.georeferencing == "measured"
    return computable - {axis.name for axis in AXES if on_host}


def needs_hits(scene: Scene, survey: Survey) -> bool:
    """Return whether NumPy computes a column, and therefore needs all reported hits."""
    names = {column.name for column in survey.stored_columns}
    return not names <= _device_column_names(scene, survey) | {*_CONSTANT_COLUMNS}


@dataclass(frozen=True, eq=False)
class DevicePoints:
    """Points of consecutive scans at one station, with the same columns as `BatchPoints`."""

    scene: Scene
    survey: Survey
    specs: list[ScanSpec]
    counts: Ints  # (scans,): number of points of each scan
    hit_counts: Ints  # (scans,): number of hits of each scan before thinning
    tally: tuple[Indices, Ints]  # nonzero hit counters, and their hits
    columns: dict[str, AnyArray]  # {column name: values}
    returns: BatchPoints | None  # returns on the host, if NumPy computes columns
    actor_rays: Records = field(default_factory=NO_ACTOR_RAYS.copy)  # of type `ACTOR_RAYS`

    def __len__(self) -> int:
        return int(self.counts.sum())

    def column(self, column: Column) -> AnyArray:
        """Return the values of a column."""
        if column.name in self.columns:
            return self.columns[column.name]
        if self.returns is not None:
            return column.make(self.returns)
        value = {"sensor": self.specs[0].sensor, "cause": SURFACE}.get(column.name, 1)
        return np.full(len(self), value, column.dtype)

    def positions_of(self, row_indices: Ints) -> Floats:
        """Return the positions of the points in the given rows, in meters.

        Positions are rounded to the precision of the survey unless NumPy computes columns.
        """
        if self.returns is not None:
            return self.returns.positions_of(row_indices)
        cells = np.stack([self.columns[axis.name][row_indices] for axis in AXES], axis=1)
        return cells * self.survey.precision_m


class VisibleBodies:
    """Bodies that a sensor can see, numbered as in its caster."""

    def __init__(self, caster: SceneCaster, bodies: Ints) -> None:
        self.caster = caster
        self.body_rows = caster.body_rows  # rows in `StoredTriangles.bodies`
        self.table = bodies[self.body_rows]  # all actors are one body, the last
        self.counters = caster.counters()
        self.device_table: Any = None
        self.device_normal_matrices: Any = None


class DeviceColumns:
    """Caster for surveys with at most one return per ray, which computes columns on the device.

    NumPy computes the columns that the device cannot compute, as described in the module docstring.
    `casters` are the casters by sensor number.
    """

    def __init__(
        self, casters: Sequence[SceneCaster], scene: Scene, survey: Survey, surfaces: SceneSurfaces
    ) -> None:
        self._scene = scene
        self._surfaces = surfaces
        self.survey = survey
        stored = {column.name for column in survey.stored_columns}
        computable = _device_column_names(scene, survey)
        self.needs_all_hits = needs_hits(scene, survey)
        if self.needs_all_hits and scene.actors:
            computable -= {*_ENERGIES}
        self.device_columns = [
            column for column in _DEVICE_COLUMNS if column.name in stored & computable
        ]
        self.energies = [column for column in self.device_columns if column.name in _ENERGIES]
        # Whether NumPy computes the energies of hits on actors. The device computes all others.
        self.needs_actor_hits = bool(scene.actors and self.energies)
        bodies, _ = surfaces.triangles.bodies()
        seen = {caster: VisibleBodies(caster, bodies) for caster in dict.fromkeys(casters)}
        self._seen_bodies = [seen[caster] for caster in casters]  # one for each sensor
        self._surface_tables: tuple[Any, ...] | None = None

    def with_moved_instances(self, scene: Scene, surfaces: SceneSurfaces) -> DeviceColumns:
        """Return a copy for a scene in which instances have moved.

        Tables that do not change stay on the device.
        """
        moved_columns = copy(self)
        moved_columns._scene = scene
        moved_columns._surfaces = surfaces
        for seen in self._seen_bodies:
            seen.device_normal_matrices = None
        return moved_columns

    def returns(
        self,
        specs: list[ScanSpec],
        pattern: Pattern,
        poses: CastPoses,
        window: tuple[int, int],
        groups: Ints,
    ) -> DevicePoints:
        """Cast consecutive scans at one station, and compute their columns.

        `window` has the first ray in `pattern` and one past the last. `groups` (scans,) has the
        first ray of each scan, counted from the start of the window.
        """
        survey = self.survey
        sensor = survey.mounted_sensors[specs[0].sensor].sensor
        seen = self._seen_bodies[specs[0].sensor]
        keep_every = survey.keep_every
        scan = check_scan(
            pattern,
            **poses.caster_arguments,
            window=window,
            t_min=sensor.min_range_m,
            t_max=sensor.max_range_m,
            keep_every=keep_every,
            groups=groups,
            tally=True,
        )
        actor_hits = _actor_hits(seen, scan, poses)
        transfer = _ColumnTransfer(
            self, seen, specs, groups, max_points=-(-len(scan) // keep_every) + len(groups)
        )
        try:
            hit_counts, tally = seen.caster.caster.scan_on_device(
                scan, transfer.make, seen.counters, actor_hits
            )
        finally:  # otherwise the device could write to memory that has been returned to the pool
            columns, (ray, distance, triangle) = transfer.finish()
        assert tally is not None
        scanned = ScannedReturns(
            PulseReturns.single_returns(ray, distance, triangle), hit_counts, None
        )
        returns = BatchPoints(
            self._scene,
            survey,
            self._surfaces,
            specs,
            scanned,
            pattern=pattern,
            start=window[0],
            poses=poses,
        )
        if self.needs_actor_hits:
            for column in self.energies:
                columns[column.name][transfer.actor_rows] = column.make(returns)
        return DevicePoints(
            scene=self._scene,
            survey=survey,
            specs=specs,
            counts=-(-hit_counts // keep_every),
            hit_counts=hit_counts,
            tally=tally,
            columns=columns,
            returns=returns if self.needs_all_hits else None,
        )

    def write_ranges(
        self, number: int, pattern: Pattern, poses: CastPoses, image: Floats32
    ) -> None:
        """Write the ranges of a sensor's rays, in meters, to `image`.

        Ray i is row ``i % len(pattern)`` of the pattern. The caller fills `image` with inf, which
        remains where a ray has no return.
        """
        sensor = self.survey.mounted_sensors[number].sensor
        seen = self._seen_bodies[number]
        scan = check_scan(
            pattern,
            **poses.caster_arguments,
            window=(0, len(image)),
            t_min=sensor.min_range_m,
            t_max=sensor.max_range_m,
        )
        images: list[Any] = []  # arrays on the device, created with the first hits

        def take(hits: DeviceHits) -> None:
            if not images:
                images.append(hits.cupy.full(len(image), np.inf, np.float32))
            images[0][hits.ray] = hits.distance

        seen.caster.caster.scan_on_device(scan, take, external_hits=_actor_hits(seen, scan, poses))
        for device_image in images:
            device_image.get(out=image)

    def tables(self, cupy: Any, seen: VisibleBodies) -> tuple[Any, ...]:
        """Return the surface tables that columns.cu reads, on the caster's device."""
        if self._surface_tables is None:
            triangles = self._surfaces.triangles
            materials = self._surfaces.materials
            normals = triangles.unit_normals if self.energies else np.zeros((1, 3), np.float32)
            tables = (
                triangles.owners,
                normals,
                materials.reflectance,
                materials.retro.astype(np.uint8),
                materials.semantic_class,
            )
            self._surface_tables = tuple(to_device(cupy, table) for table in tables)
        if seen.device_table is None:
            seen.device_table = to_device(cupy, seen.table)
        if seen.device_normal_matrices is None:
            normal_matrices = self._surfaces.triangles.bodies()[1][seen.body_rows]
            seen.device_normal_matrices = to_device(cupy, normal_matrices)
        return seen.device_table, *self._surface_tables, seen.device_normal_matrices


def _actor_hits(seen: VisibleBodies, scan: Scan, poses: CastPoses) -> ExternalHits | None:
    """Find the hits of a scan on visible actors. Return None if there are no actors.

    All actors are the last body, and its triangles are numbered from 0.
    """
    if not poses.actor_trajectories:
        return None
    hits = seen.caster.find_actor_hits(scan, poses)
    return replace(hits, triangle=hits.triangle - np.int32(seen.table[-1, 0]))


class _ColumnTransfer:
    """Computation of a batch's columns on the device, and their transfer to the host.

    `maker` has the columns and the surface tables. The caster passes the hits of the batch to
    `make` in parts. `finish` returns the columns of all hits.
    """

    def __init__(
        self,
        maker: DeviceColumns,
        seen: VisibleBodies,
        specs: list[ScanSpec],
        groups: Ints,
        max_points: int,
    ) -> None:
        self._maker = maker
        self._seen = seen
        self._specs = specs
        self._groups = groups
        self._max_points = max_points
        self._buffers: _TransferBuffers | None = None
        self._count = 0
        # Rows, rays, distances and triangles of the hits on actors, for each call of `make`.
        self._on_actors: list[tuple[AnyArray, ...]] = [_NO_HITS]

    def make(self, hits: DeviceHits) -> None:
        """Compute the columns of the next hits, in ray order, and send the values to the host."""
        if not len(hits):
            return
        buffers = self._buffers = self._buffers or self._start(hits.cupy)
        device_arrays = self._compute(hits, buffers)
        row_range = slice(self._count, self._count + len(hits))
        pairs = [
            (device_arrays[column], host[row_range]) for column, host in buffers.columns.items()
        ]
        hit_arrays = hits.ray, hits.distance, device_arrays[_TRIANGLE]
        pairs += [
            (array, host[row_range]) for array, host in zip(hit_arrays, buffers.hits, strict=False)
        ]
        buffers.outbox.send(pairs)
        if self._maker.needs_actor_hits:
            self._on_actors.append(self._actor_hits(hits))
        self._count += len(hits)

    def _compute(self, hits: DeviceHits, buffers: _TransferBuffers) -> dict[Column, Any]:
        """Compute columns of hits on the device. Arrays of unneeded columns have one element."""
        computed = {*buffers.columns, *([_TRIANGLE] if buffers.hits else [])}
        arrays = {
            column: hits.cupy.empty(len(hits) if column in computed else 1, column.dtype)
            for column in _DEVICE_COLUMNS
        }
        flags = sum(1 << _DEVICE_COLUMNS.index(column) for column in computed)
        arguments = (
            hits.ray,
            hits.distance,
            hits.triangle,
            hits.instance,
            *hits.rays(),
            np.int64(len(hits)),
            np.int32(flags),
            *buffers.kernel_arguments,
            *arrays.values(),
        )
        buffers.kernel((-(-len(hits) // _BLOCK),), (_BLOCK,), arguments)
        return arrays

    def _actor_hits(self, hits: DeviceHits) -> tuple[AnyArray, ...]:
        """Return the rows of the hits on actors, and their rays, distances and triangles."""
        on_actors = hits.cupy.flatnonzero(hits.instance == len(self._seen.table) - 1)
        columns = (
            on_actors,
            hits.ray[on_actors],
            hits.distance[on_actors],
            hits.triangle[on_actors],
        )
        row_indices, ray, distance, triangle = (array.get() for array in columns)
        triangle += np.int32(self._seen.table[-1, 0])
        return self._count + row_indices, ray, distance, triangle

    @property
    def actor_rows(self) -> Ints:
        """Rows of the hits on actors among all hits of the batch."""
        return np.concatenate([row_indices for row_indices, *_ in self._on_actors])

    def finish(self) -> tuple[dict[str, AnyArray], tuple[AnyArray, ...]]:
        """Wait for the values. Return the columns by name, and the hits that NumPy needs.

        The hits are arrays of rays, distances and triangles. They cover all hits, only the hits on
        actors, or no hits.
        """
        if self._buffers is None:
            return {c.name: np.zeros(0, c.dtype) for c in self._maker.device_columns}, _NO_HITS[1:]
        self._buffers.outbox.wait()
        sizes = (self._count, self._max_points)
        columns = {
            column.name: trim_to_count(host, *sizes)
            for column, host in self._buffers.columns.items()
        }
        if self._buffers.hits:
            return columns, tuple(trim_to_count(host, *sizes) for host in self._buffers.hits)
        _, *hits = map(np.concatenate, zip(*self._on_actors, strict=True))
        return columns, tuple(hits)

    def _start(self, cupy: Any) -> _TransferBuffers:
        """Allocate host arrays, and send the kernel arguments that are the same for all hits."""
        maker = self._maker
        kernel_arguments = self._kernel_arguments(cupy)
        outbox = CopyQueue(cupy)
        columns = {
            column: pinned_array(cupy, self._max_points, column.dtype)
            for column in maker.device_columns
        }
        hits = (
            [pinned_array(cupy, self._max_points, kind) for kind in _HITS]
            if maker.needs_all_hits
            else []
        )
        kernel = _kernel(cupy, cupy.cuda.Device().id)
        return _TransferBuffers(kernel, kernel_arguments, outbox, columns, hits)

    def _kernel_arguments(self, cupy: Any) -> tuple[Any, ...]:
        """Return the kernel arguments that follow the hits and precede the columns.

        They are device arrays and scalars.
        """
        maker = self._maker
        specs = self._specs
        sensor = maker.survey.mounted_sensors[specs[0].sensor].sensor
        bodies, owners, normals, reflectance, retro, classes, normal_matrices = maker.tables(
            cupy, self._seen
        )
        firings = np.arange(specs[0].firings[0], specs[-1].firings[1], dtype=np.int64)
        return (
            np.float64(maker.survey.precision_m),
            cupy.asarray(self._groups),
            np.int32(len(specs)),
            cupy.asarray(sensor.begins_ns(firings)),
            cupy.asarray(sensor.beams.time_ns),
            np.int32(sensor.channels),
            np.int64(specs[0].start_ns),
            bodies,
            owners,
            normals,
            normal_matrices,
            reflectance,
            retro,
            np.float64(RETRO_GAIN),
            np.float64(REFERENCE_M),
            np.float64(NEAREST_M),
            classes,
        )


@dataclass(frozen=True, eq=False)
class _TransferBuffers:
    """Kernel and page-locked host arrays for the transfer of a batch."""

    kernel: Any
    kernel_arguments: tuple[Any, ...]  # arguments between hits and columns
    outbox: CopyQueue
    columns: dict[Column, AnyArray]  # sized for all rays
    hits: list[AnyArray]  # arrays as in `_HITS`; empty unless NumPy needs all hits


@lru_cache(maxsize=16)
def _kernel(cupy: Any, device: int) -> Any:
    """Compile columns.cu for the current device.

    `device` is the number of this device. The compiled kernel is cached for each device.
    """
    code = importlib.resources.files(__package__).joinpath("columns.cu").read_text("utf-8")
    module = cupy.RawModule(code=f'#line 1 "columns.cu"\n{code}', options=OPTIONS)
    return module.get_function("columns")
