"""Crosstalk: pulses of the other sensors of a survey that a receiver takes for its own."""

from __future__ import annotations

from bisect import bisect_left
from functools import partial
from typing import NamedTuple

import numpy as np

from raybeam import Pattern

from ..base.arrays import Floats, Indices, Ints, Ints32, owned
from ..base.elementary import arccos, exp
from ..base.elementary_scalars import sin_cos_of
from ..base.vectors import into_axes, length, products, turned
from ..columns.table import CAUSES
from ..sensor import Sensor, Survey
from ..sensor.materials import at_right_angles
from ..sensor.optics import LIGHT_M_NS
from ..sensor.random_numbers import Purpose
from ..sensor.survey import begin_ns
from .detection import passes
from .motion import CastPoses, Clock
from .returns import RETURN_COLUMNS, PulseReturns, merged, numbers, returns_without_surface
from .scene_caster import SceneCaster
from .step import Memory, PulseBatch, PulseStep, Role, Setup, Sizes
from .surfaces import Surfaces

OTHER = Purpose(23, "noise of the energy of another sensor's pulse")
CROSSTALK = CAUSES.index("crosstalk")
CELL_RAYS = 1 << 6  # rays that are compared with a spot at a time
FILTER_NM = 20.0  # wavelengths that differ by more do not pass a receiver's filter
SLACK_NS = 10.0  # by which the time of a pulse at the receiver may be off before it is computed


class _Spots(NamedTuple):
    """Where pulses of a sensor hit something: arrays (n,)."""

    time: Floats  # when, nanoseconds since the station began
    place: Floats  # (n, 3)
    normal: Floats  # (n, 3)
    triangle: Ints32
    distance: Floats  # from that sensor


class CrosstalkStep(PulseStep):
    """Adds the pulses of other sensors that a sensor receives.

    A pulse of another sensor lights a spot. A ray receives its light if the spot is in the field of
    view of its receiver, as wide as its beam, nothing stands between them, and the light arrives
    while the receiver waits for its own pulse.
    """

    role = Role.RECEIVES
    effects = ("Crosstalk",)
    reads = "ray", "distance"
    writes = RETURN_COLUMNS
    causes = (CROSSTALK,)
    purposes = (OTHER,)

    def __init__(self, setup: Setup, caster: SceneCaster, surfaces: Surfaces) -> None:
        super().__init__(setup, caster, surfaces)
        self._survey = setup.survey
        self._sensor = setup.sensor
        wide, _ = setup.reporting.of(self._sensor.optics)
        self._cosine = sin_cos_of(wide / 2)[1]
        nm = self._sensor.optics.wavelength_nm
        self._others = [
            other
            for other, carried in enumerate(self._survey.carried)
            if other != setup.number and abs(carried.sensor.optics.wavelength_nm - nm) <= FILTER_NM
        ]

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return setup.noise.crosstalk

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """See `PulseStep.memory`: a cause of each return, rays, and pulses of others."""
        others = _pulses_meanwhile(setup.survey, setup.sensor)
        return Memory(kept=10 * sizes.returns, casting=(120 + 200 * others) * sizes.beams)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        rays = np.arange(batch.start, batch.stop)
        row, distance, energy = self.received(batch.keys.scan, rays, *batch.middles, batch.here)
        order = np.lexsort((distance, row))
        ray = rays[row[order]]
        distance = distance[order]
        energy = energy[order]
        scan, number = batch.keys.scan_and_number(ray)
        seen = passes(self.setup.noise, OTHER, energy, scan, number, numbers(ray))
        others = returns_without_surface(
            returns, ray[seen], distance[seen], energy[seen], CROSSTALK
        )
        return merged(returns, others)

    def received(
        self, scan: int, rays: Ints, origins: Floats, directions: Floats, poses: CastPoses
    ) -> tuple[Indices, Floats, Floats]:
        """Find pulses of other sensors that consecutive rays (n,) receive.

        `rays` count from the begin of a scan. Origins and directions are (n, 3).

        Returns
        -------
        Rows of the rays, distances at which they seem to be, metres, and energies: (k,) each.
        """
        from . import stray_loops  # not before: numba takes half a second to import

        spec = self._survey.scan(scan)
        sensor = self._sensor
        firing, channel = np.divmod(rays, sensor.channels)
        firing = firing + spec.firings[0]
        fired = sensor.begins_ns(firing) + sensor.beams.time_ns[channel]
        gate = 2 / LIGHT_M_NS * np.array([sensor.min_range_m, sensor.max_range_m])
        order = np.argsort(fired, kind="stable")
        found: list[tuple[Indices, Floats, Floats]] = []
        for other in self._others:
            lidar = self._survey.carried[other].sensor
            reach = (lidar.max_range_m + sensor.max_range_m) / LIGHT_M_NS
            span = fired[order[0]] - reach, fired[order[-1]] + gate[1]
            spots = self._spots(other, spec.station, spec.start_ns, span, poses)
            pairs = self._open(fired, order, origins, directions, spots, gate)
            most = int(np.maximum(pairs[2] - pairs[1], 0).sum())
            output = stray_loops.ReceivedSpots(
                row=np.empty(most, np.int64),
                spot=np.empty(most, np.int64),
                distance=np.empty(most),
                range_m=np.empty(most),
            )
            count = stray_loops.receive(
                stray_loops.SpotPairs(*pairs),
                stray_loops.ReceivingRays(order, owned(fired), owned(origins), owned(directions)),
                stray_loops.LitSpots(owned(spots.time), owned(spots.place)),
                stray_loops.ReceptionLimits(self._cosine, sensor.min_range_m, sensor.max_range_m),
                output,
            )
            row, spot, distance, far = output
            row = row[:count]
            spot = spot[:count]
            distance = distance[:count]
            far = far[:count]
            towards = spots.place[spot] - origins[row]
            when = fired[row] + spec.start_ns
            free = self.caster.free(origins[row], towards, far, when, poses.ways)
            energy = self._energy(spots, spot[free], towards[free], far[free])
            found.append((row[free], distance[free], energy))
        if not found:
            return np.zeros(0, np.intp), np.zeros(0), np.zeros(0)
        rows, distances, energies = map(np.concatenate, zip(*found, strict=True))
        return rows, distances, energies

    def _open(
        self,
        fired: Floats,
        order: Indices,
        origins: Floats,
        directions: Floats,
        spots: _Spots,
        gate: Floats,
    ) -> tuple[Indices, Indices, Indices]:
        """Spots, and from which row of `order` to which rays may see them, while they wait."""
        times = fired[order]
        about = np.minimum(np.searchsorted(times, spots.time), len(times) - 1)
        away = spots.place - origins[order[about]]
        far = np.sqrt(products(away.T, away.T))
        arrives = spots.time + far / LIGHT_M_NS
        first = np.searchsorted(times, arrives - gate[1] - SLACK_NS)
        stop = np.searchsorted(times, arrives - gate[0] + SLACK_NS, side="right")
        # Rays that are fired one after the other look into a cone; few spots are in it.
        begins = np.arange(0, len(order), CELL_RAYS)
        ahead = directions[order]
        sums = np.add.reduceat(ahead, begins, axis=0)
        axes = sums / np.maximum(length(sums), 1e-9)[:, None]
        least = np.minimum.reduceat(
            products(axes[np.arange(len(order)) // CELL_RAYS].T, ahead.T), begins
        )
        opening = arccos(np.clip(least, -1, 1)) + arccos(self._cosine)
        with np.errstate(invalid="ignore", divide="ignore"):
            opening_m = SLACK_NS * LIGHT_M_NS / far  # rays of a cell start at different places
        spot, cell = _expanded(first // CELL_RAYS, np.where(stop > first, -(-stop // CELL_RAYS), 0))
        off = arccos(np.clip(products(axes[cell].T, away[spot].T) / far[spot], -1, 1))
        seen = ~(off > opening[cell] + opening_m[spot])
        spot = spot[seen]
        cell = cell[seen]
        low = np.maximum(first[spot], cell * CELL_RAYS)
        return spot, low, np.minimum(stop[spot], (cell + 1) * CELL_RAYS)

    def _spots(
        self, other: int, station: int, start_ns: int, span: tuple[float, float], poses: CastPoses
    ) -> _Spots:
        """Where the pulses of another sensor hit something, fired within a span of time."""
        carried = self._survey.carried[other]
        path = self._survey.path
        sensor: Sensor = carried.sensor
        firings = np.arange(*_fired_in(sensor, self._survey.steps_each[other], span))
        begins = sensor.begins_ns(firings)
        ahead = sensor.directions(firings)
        starts = sensor.origins(firings)
        starts = np.zeros_like(ahead) if starts is None else starts
        fired = (begins[:, None] + sensor.beams.time_ns).reshape(-1)
        ahead = turned(ahead.reshape(-1, 3), carried.mount.rotation)
        starts = turned(starts.reshape(-1, 3), carried.mount.rotation) + carried.mount.position
        places, turns = path.poses(station, np.minimum(begins + sensor.lead_ns, path.duration_ns))
        if turns is not None:
            back = np.repeat(turns.transpose(0, 2, 1), sensor.channels, axis=0)
            ahead = into_axes(ahead, back)
            starts = into_axes(starts, back)
        starts = starts + np.repeat(places, sensor.channels, axis=0)
        now = CastPoses(np.zeros(3), clock=Clock(fired + start_ns, np.zeros(1), poses.ways))
        low = sensor.min_range_m
        high = sensor.max_range_m
        found = self.caster.scan(Pattern(ahead, starts), now, t_min=low, t_max=high)
        ray = found.ray.astype(np.int64)
        distance = found.distance
        times = fired[ray] + start_ns
        return _Spots(
            fired[ray] + distance / LIGHT_M_NS,
            starts[ray] + distance[:, None] * ahead[ray],
            self.surfaces.normals(found.triangle, times, poses.ways),
            found.triangle,
            distance,
        )

    def _energy(self, spots: _Spots, spot: Indices, towards: Floats, far: Floats) -> Floats:
        """Energies that are received of spots: (n,), as of a sensor's own pulses."""
        surfaces = self.surfaces
        nm = self._sensor.optics.wavelength_nm
        triangle = spots.triangle[spot]
        cosine = np.abs(products(spots.normal[spot].T, towards.T)) / far
        # The air on the way there and back.
        both = self._survey.extinction(self._sensor) * (spots.distance[spot] + far)
        kinds = surfaces.kinds(triangle)
        table = surfaces.at(nm)
        # A retro-reflector sends the light of a sensor back to that one alone.
        share = table.reflectance[kinds] * ~table.retro[kinds]
        return np.asarray(share * cosine * at_right_angles(far) * exp(-both))


def _expanded(first: Indices, stop: Indices) -> tuple[Indices, Indices]:
    """Row and number of each whole number of ranges (n,): (k,) each."""
    each = np.maximum(stop - first, 0)
    row = np.repeat(np.arange(len(each)), each)
    return row, first[row] + np.arange(len(row)) - np.repeat(np.cumsum(each) - each, each)


def _fired_in(sensor: Sensor, steps: int, span: tuple[float, float]) -> tuple[int, int]:
    """First firing within a span of time, and one past the last."""
    last = range(sensor.firings(steps - 1)[1])
    begins = partial(begin_ns, sensor)
    early = span[0] - float(sensor.beams.time_ns.max())  # its slowest beam is in the span
    return bisect_left(last, early, key=begins), bisect_left(last, span[1], key=begins)


def _pulses_meanwhile(survey: Survey, sensor: Sensor) -> float:
    """Pulses of all sensors but one in the time in which that one fires once."""

    def rate(one: Sensor) -> float:
        first, stop = one.firings(0)
        begin, end = one.begins_ns(np.array([first, stop], np.int64))
        return float((stop - first) * one.channels / (end - begin))

    every = sum(rate(carried.sensor) for carried in survey.carried)
    return every / rate(sensor) - 1
