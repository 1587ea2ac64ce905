"""Crosstalk between sensors, whose receivers cannot distinguish foreign pulses from their own."""

from __future__ import annotations

from bisect import bisect_left
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from raybeam import Pattern

from ...casting.motion import CastPoses, FiringClock
from ...casting.scene_caster import SceneCaster
from ...casting.surfaces import SceneSurfaces
from ...columns.table import CAUSES
from ...media.materials import normal_incidence_energy
from ...numerics.arrays import Floats, Indices, Ints, Ints32, to_writable
from ...numerics.elementary import arccos, exp
from ...numerics.elementary_scalars import sin_cos_of
from ...numerics.random_numbers import Purpose
from ...numerics.vectors import dot, norm, rotate, rotate_into_frames
from ...sensor import Sensor
from ...sensor.optics import LIGHT_M_NS
from ...survey.survey import ScanSpec, Survey, firing_start_ns
from ..returns import (
    RETURN_COLUMNS,
    PulseReturns,
    merge_returns,
    number_within_ray,
    returns_without_surface,
)
from .detection import exceeds_threshold
from .step import Memory, PulseBatch, PulseStep, Role, Setup, Sizes

if TYPE_CHECKING:
    from .stray_loops import ReceivedSpots

FOREIGN_PULSE = Purpose(23, "energy noise of a pulse from another sensor")
CROSSTALK = CAUSES.index("crosstalk")
CELL_RAYS = 1 << 6  # number of rays that are compared with a spot at a time
FILTER_NM = 20.0  # maximum difference of wavelengths that passes a receiver's filter
SLACK_NS = 10.0  # maximum error of the estimated time at which a pulse reaches the receiver


class ReceivedPulses(NamedTuple):
    """Pulses of other sensors that rays receive.

    All arrays have shape (k,).
    """

    row: Indices  # rows of the receiving rays
    distance: Floats  # apparent distance of the pulse, meters
    energy: Floats  # 1 for a white surface at `REFERENCE_M`


class _WaitingRays(NamedTuple):
    """Rays whose receivers wait for light.

    Arrays have shape (n,). Arrays of vectors have shape (n, 3) and are in the scene frame.
    """

    fired: Floats  # firing times, nanoseconds since the start of the station
    order: Indices  # rows of the rays, sorted by firing time
    origins: Floats
    directions: Floats
    gate: Floats  # (2,): start and end of the wait after firing, nanoseconds


class _Spots(NamedTuple):
    """Points on surfaces that the pulses of a sensor illuminate.

    All arrays have shape (n,).
    """

    time: Floats  # when the pulse illuminates the spot, nanoseconds since the start of the station
    position: Floats  # (n, 3), meters, scene frame
    normal: Floats  # (n, 3), unit vectors
    triangle: Ints32
    distance: Floats  # distance from the sensor, meters


class _Candidates(NamedTuple):
    """Spots, and the ranges of consecutive rays that may see them.

    All arrays have shape (k,).
    """

    spot: Indices
    start: Indices  # index of the first ray in `_WaitingRays.order`
    stop: Indices  # one past the index of the last ray


class CrosstalkStep(PulseStep):
    """Simulation step that adds the pulses of other sensors that a sensor receives.

    A pulse of another sensor illuminates a spot. A ray receives light from the spot if the spot is
    visible and in the field of view of the ray's receiver, which is as wide as the beam, and if
    the light arrives while the receiver waits for the ray's own pulse.
    """

    role = Role.RECEIVES
    effects = ("Crosstalk",)
    reads = "ray", "distance"
    writes = RETURN_COLUMNS
    causes = (CROSSTALK,)
    purposes = (FOREIGN_PULSE,)
    on_recordings = (
        "`noise.crosstalk` cannot be simulated on a recording, because the pulses of other sensors "
        "illuminate surfaces that the recording does not contain. Reconstruct the scene with "
        "`lidarpool twin`, and simulate all sensors in it."
    )

    def __init__(self, setup: Setup, caster: SceneCaster, surfaces: SceneSurfaces) -> None:
        super().__init__(setup, caster, surfaces)
        self._survey = setup.survey
        self._sensor = setup.sensor
        divergence = setup.reporting.divergence(self._sensor.optics)
        self._cosine = sin_cos_of(divergence / 2)[1]  # cosine of half a ray's field of view
        nm = self._sensor.optics.simulated_nm
        self._other_sensors = [
            number
            for number, carried in enumerate(self._survey.mounted_sensors)
            if number != setup.number and abs(carried.sensor.optics.simulated_nm - nm) <= FILTER_NM
        ]

    def with_moved_instances(self, setup: Setup, surfaces: SceneSurfaces) -> PulseStep:
        """Return a copy for a scene in which instances have moved."""
        return self.with_setup(setup, surfaces)

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether the sensor has crosstalk."""
        return setup.noise.crosstalk

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """Return the memory of return causes, rays and foreign pulses, in bytes."""
        foreign_pulses = _foreign_pulses(setup.survey, setup.sensor)
        return Memory(
            retained=10 * sizes.return_count, casting=(120 + 180 * foreign_pulses) * sizes.beams
        )

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Add the received foreign pulses to the returns of a batch."""
        rays = np.arange(batch.start, batch.stop)
        row, distance, energy = self.receive(
            batch.keys.scan, rays, *batch.central_rays, batch.subray_poses
        )
        order = np.lexsort((distance, row))
        ray = rays[row[order]]
        distance = distance[order]
        energy = energy[order]
        scan, number = batch.keys.scan_and_number(ray)
        detected = exceeds_threshold(
            self.setup.noise, FOREIGN_PULSE, energy, scan, number, number_within_ray(ray)
        )
        foreign_returns = returns_without_surface(
            returns, ray[detected], distance[detected], energy[detected], CROSSTALK
        )
        return merge_returns(returns, foreign_returns)

    def receive(
        self, scan: int, rays: Ints, origins: Floats, directions: Floats, poses: CastPoses
    ) -> ReceivedPulses:
        """Return the foreign pulses that consecutive rays receive.

        `rays` are numbers counted from the first ray of scan `scan`. `origins` (n, 3) in meters and
        unit `directions` (n, 3) are in the scene frame.
        """
        spec = self._survey.scan(scan)
        sensor = self._sensor
        firing, channel = np.divmod(rays, sensor.channels)
        firing = firing + spec.firings[0]
        fired = sensor.begins_ns(firing) + sensor.beams.time_ns[channel]
        gate = 2 / LIGHT_M_NS * np.array([sensor.min_range_m, sensor.max_range_m])
        order = np.argsort(fired, kind="stable")
        waiting = _WaitingRays(fired, order, origins, directions, gate)
        pulses = [
            self._received_from(number, spec, waiting, poses) for number in self._other_sensors
        ]
        if not pulses:
            return ReceivedPulses(np.zeros(0, np.intp), np.zeros(0), np.zeros(0))
        return ReceivedPulses(*map(np.concatenate, zip(*pulses, strict=True)))

    def _received_from(
        self, number: int, spec: ScanSpec, waiting: _WaitingRays, poses: CastPoses
    ) -> ReceivedPulses:
        """Return the foreign pulses that rays receive from sensor `number` of the survey."""
        max_range_m = self._survey.mounted_sensors[number].sensor.max_range_m
        reach_ns = (max_range_m + self._sensor.max_range_m) / LIGHT_M_NS
        first_ns = waiting.fired[waiting.order[0]] - reach_ns
        last_ns = waiting.fired[waiting.order[-1]] + waiting.gate[1]
        spots = self._spots(number, spec, (first_ns, last_ns), poses)
        row, spot, distance, range_m = self._sightings(waiting, spots)
        towards = spots.position[spot] - waiting.origins[row]
        times = waiting.fired[row] + spec.start_ns
        visible = self.caster.is_visible(
            waiting.origins[row], towards, range_m, times, poses.actor_trajectories
        )
        energy = self._energy(spots, spot[visible], towards[visible], range_m[visible])
        return ReceivedPulses(row[visible], distance[visible], energy)

    def _sightings(self, waiting: _WaitingRays, spots: _Spots) -> ReceivedSpots:
        """Pair each ray with the spots in its field of view whose light arrives while it waits."""
        from . import stray_loops  # imported here because numba takes half a second to import

        candidates = self._candidates(waiting, spots)
        max_count = int(np.maximum(candidates.stop - candidates.start, 0).sum())
        sightings = stray_loops.ReceivedSpots(
            row=np.empty(max_count, np.int64),
            spot=np.empty(max_count, np.int64),
            distance=np.empty(max_count),
            range_m=np.empty(max_count),
        )
        count = stray_loops.receive(
            stray_loops.SpotPairs(candidates.spot, candidates.start, candidates.stop),
            stray_loops.ReceivingRays(
                waiting.order,
                to_writable(waiting.fired),
                to_writable(waiting.origins),
                to_writable(waiting.directions),
            ),
            stray_loops.LitSpots(to_writable(spots.time), to_writable(spots.position)),
            stray_loops.ReceptionLimits(
                self._cosine, self._sensor.min_range_m, self._sensor.max_range_m
            ),
            sightings,
        )
        return sightings.first(count)

    def _candidates(self, waiting: _WaitingRays, spots: _Spots) -> _Candidates:
        """Return spots, and the rays that may receive the light of each spot.

        These rays wait when the light of the spot arrives, and their cell faces the spot.
        """
        times = waiting.fired[waiting.order]
        nearest_firing = np.minimum(np.searchsorted(times, spots.time), len(times) - 1)
        towards = spots.position - waiting.origins[waiting.order[nearest_firing]]
        distance = np.sqrt(dot(towards.T, towards.T))
        arrival = spots.time + distance / LIGHT_M_NS
        first = np.searchsorted(times, arrival - waiting.gate[1] - SLACK_NS)
        stop = np.searchsorted(times, arrival - waiting.gate[0] + SLACK_NS, side="right")
        axes, opening = self._cells(waiting.directions[waiting.order])
        with np.errstate(invalid="ignore", divide="ignore"):
            slack = SLACK_NS * LIGHT_M_NS / distance  # rays of a cell have different origins
        spot, cell = _expanded(first // CELL_RAYS, np.where(stop > first, -(-stop // CELL_RAYS), 0))
        angles = arccos(np.clip(dot(axes[cell].T, towards[spot].T) / distance[spot], -1, 1))
        in_view = ~(angles > opening[cell] + slack[spot])
        spot = spot[in_view]
        cell = cell[in_view]
        first_row = np.maximum(first[spot], cell * CELL_RAYS)
        return _Candidates(spot, first_row, np.minimum(stop[spot], (cell + 1) * CELL_RAYS))

    def _cells(self, directions: Floats) -> tuple[Floats, Floats]:
        """Return the axes and opening angles of cones that enclose consecutive rays.

        The axes have shape (c, 3), and the angles (c,) are in radians. Consecutive rays lie in a
        narrow cone, which contains few spots.
        """
        cell_starts = np.arange(0, len(directions), CELL_RAYS)
        sums = np.add.reduceat(directions, cell_starts, axis=0)
        axes = sums / np.maximum(norm(sums), 1e-9)[:, None]
        min_cosine = np.minimum.reduceat(
            dot(axes[np.arange(len(directions)) // CELL_RAYS].T, directions.T), cell_starts
        )
        return axes, arccos(np.clip(min_cosine, -1, 1)) + arccos(self._cosine)

    def _spots(
        self, number: int, spec: ScanSpec, span: tuple[float, float], poses: CastPoses
    ) -> _Spots:
        """Cast the pulses that another sensor fires in a time interval, and return their spots."""
        sensor: Sensor = self._survey.mounted_sensors[number].sensor
        firings = np.arange(*_firings_in(sensor, self._survey.steps_each[number], span))
        firing_starts = sensor.begins_ns(firings)
        fired = (firing_starts[:, None] + sensor.beams.time_ns).reshape(-1)
        origins, directions = self._fired_rays(number, spec.station, firings, firing_starts)
        trajectories = poses.actor_trajectories
        hits = self.caster.by_sensor[number].scan(
            Pattern(directions, origins),
            CastPoses(
                np.zeros(3), clock=FiringClock(fired + spec.start_ns, np.zeros(1), trajectories)
            ),
            t_min=sensor.min_range_m,
            t_max=sensor.max_range_m,
        )
        ray = hits.ray.astype(np.int64)
        distance = hits.distance
        triangle = hits.triangle
        if self.caster.unseen is not None:  # remove spots on objects that this sensor cannot see
            seen = np.flatnonzero(~self.caster.unseen[self.surfaces.triangles.objects(triangle)])
            ray = ray[seen]
            distance = distance[seen]
            triangle = triangle[seen]
        times = fired[ray] + spec.start_ns
        return _Spots(
            fired[ray] + distance / LIGHT_M_NS,
            origins[ray] + distance[:, None] * directions[ray],
            self.surfaces.normals(triangle, times, trajectories),
            triangle,
            distance,
        )

    def _fired_rays(
        self, number: int, station: int, firings: Ints, firing_starts: Floats
    ) -> tuple[Floats, Floats]:
        """Return the origins and directions of the rays that a sensor fires, in the scene frame."""
        carried = self._survey.mounted_sensors[number]
        path = self._survey.path
        sensor = carried.sensor
        directions = sensor.directions(firings)
        origins = sensor.origins(firings)
        origins = np.zeros_like(directions) if origins is None else origins
        directions = rotate(directions.reshape(-1, 3), carried.mount.rotation)
        origins = rotate(origins.reshape(-1, 3), carried.mount.rotation) + carried.mount.position
        times = np.minimum(firing_starts + sensor.lead_ns, path.duration_ns)
        positions, rotations = path.poses(station, times)
        if rotations is not None:
            inverse = np.repeat(rotations.transpose(0, 2, 1), sensor.channels, axis=0)
            directions = rotate_into_frames(directions, inverse)
            origins = rotate_into_frames(origins, inverse)
        return origins + np.repeat(positions, sensor.channels, axis=0), directions

    def _energy(self, spots: _Spots, spot: Indices, towards: Floats, path_m: Floats) -> Floats:
        """Return the energies received from spots, relative to a white surface at `REFERENCE_M`.

        `spot` (n,) are rows of `spots`. `towards` (n, 3) are vectors from the receivers to the
        spots, whose lengths are `path_m` (n,).
        """
        surfaces = self.surfaces
        triangle = spots.triangle[spot]
        cosine = np.abs(dot(spots.normal[spot].T, towards.T)) / path_m
        # Optical depth of the air from the other sensor to the spot and on to the receiver.
        air_depth = self._survey.extinction(self._sensor) * (spots.distance[spot] + path_m)
        kinds = surfaces.kinds(triangle)
        table = surfaces.at_wavelength(self._sensor.optics.simulated_nm)
        # A retroreflector returns light only to the sensor that emitted it.
        share = table.reflectance[kinds] * ~table.retro[kinds]
        return np.asarray(share * cosine * normal_incidence_energy(path_m) * exp(-air_depth))


def _expanded(first: Indices, stop: Indices) -> tuple[Indices, Indices]:
    """List all integers in half-open ranges. Return the range number and value of each."""
    counts = np.maximum(stop - first, 0)
    row = np.repeat(np.arange(len(counts)), counts)
    return row, first[row] + np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)


def _firings_in(sensor: Sensor, steps: int, span: tuple[float, float]) -> tuple[int, int]:
    """Return the start and stop of the firings that have beams in a time interval.

    The interval is in nanoseconds since the start of the station.
    """
    firings = range(sensor.firings(steps - 1)[1])
    start_of = partial(firing_start_ns, sensor)
    slowest_ns = float(sensor.beams.time_ns.max())
    start = bisect_left(firings, span[0] - slowest_ns, key=start_of)
    return start, bisect_left(firings, span[1], key=start_of)


def _foreign_pulses(survey: Survey, sensor: Sensor) -> float:
    """Return the number of pulses that other sensors fire per pulse of a sensor."""

    def rate(lidar: Sensor) -> float:
        first, stop = lidar.firings(0)
        begin, end = lidar.begins_ns(np.array([first, stop], np.int64))
        return float((stop - first) * lidar.channels / (end - begin))

    total = sum(rate(carried.sensor) for carried in survey.mounted_sensors)
    return total / rate(sensor) - 1
