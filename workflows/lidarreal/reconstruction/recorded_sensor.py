"""Sensor of a recording: its beams, its rotation and its noise."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarfiles.clouds.recording import Recording, RecordingInfo
from lidarsim._version import __version__
from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.numerics.even_samples import even_indices
from lidarsim.scene.scene import Scene
from lidarsim.sensor.models import Performance, SensorModel
from lidarsim.words import plural

from ..comparing.fit.fitting import Fit, fit
from ..scan_patterns.lasers import RingLasers
from .alignment import AlignedSweeps, Alignment
from .blocked_directions import BlockedDirections
from .lost_pulses import firings_per_turn
from .motion import Motion
from .range_noise import RangeNoise, estimate_range_noise
from .recorded_sweeps import RecordedSweeps, Rotation
from .reflectances import RANGES_M, IntensityModel, Response
from .twin import TwinPose

_FIT_SWEEPS = 13  # sweeps to which the sensor noise is fitted
_RATE_DECIMALS = 4
_ORIGIN_DECIMALS = 4
_ANGLE_DECIMALS = 3
# Median offset over the rings, in meters and radians, from which ring offsets are significant.
_MIN_RING_OFFSETS = (0.005, np.radians(0.02), np.radians(0.02))
_NOISE_DECIMALS = 5
# Limits of the detection. The map already lacks the surfaces that the sensor did not detect.
_DETECTION = ("detection", "dropout", "false_alarms", "precision", "range_at_threshold_m")
_RANGE_NOISE = ("range_m", "range_per_m", "range_at_threshold_m", "precision")
_MIN_LEAD = 0.01  # minimum time from the first point to the timestamp, in revolutions


class SweepTiming(NamedTuple):
    """Timing of the sweeps, and rotation of the sensor."""

    rate_hz: float  # revolutions per second
    revolutions: int  # includes dropped sweeps
    first_s: float  # time from the timestamp of a sweep to its start, at most 0
    rotation: Rotation | None  # None if unknown

    @classmethod
    def from_sweeps(cls, sweeps: AlignedSweeps) -> SweepTiming:
        """Determine the timing of the recorded sweeps."""
        recorded = sweeps.recorded
        alignment = sweeps.alignment
        span_s = float(alignment.times_s[-1] - alignment.times_s[0])
        # Timestamps jitter, but their mean interval does not. An interval with dropped sweeps
        # counts as several intervals.
        steps = max(round(span_s / alignment.sweep_s), 1)
        rate_hz = round(steps / span_s, _RATE_DECIMALS)
        period_s = 1 / rate_hz
        first_s = 0.0 if recorded.point_times is None else recorded.point_times.first_s
        first_s = first_s if first_s < -_MIN_LEAD * period_s else 0.0
        rotation = recorded.rotation(period_s, first_s)
        motion = alignment.motion
        if rotation is None and motion.is_turning:
            rotation = recorded.starts(is_clockwise=motion.is_clockwise)
        if rotation is not None and motion.is_centered:
            first_s = -0.5 * period_s
            rotation = rotation._replace(start_deg=(rotation.start_deg + 180) % 360)
        return cls(rate_hz, steps + 1, first_s, rotation)

    def start(self, alignment: Alignment) -> TwinPose:
        """Return the sensor pose and the time at the start of the first sweep."""
        step, step_s = alignment.step(0)
        pose = alignment.poses[0] @ step.fraction(self.first_s / step_s)
        return TwinPose(pose, float(alignment.times_s[0]) + self.first_s)

    def stop(self, alignment: Alignment) -> TwinPose:
        """Return the extrapolated sensor pose and the time at the end of the last sweep."""
        span_s = float(alignment.times_s[-1] - alignment.times_s[0])
        rest_s = self.first_s + self.revolutions / self.rate_hz - span_s
        step, step_s = alignment.step(len(alignment.poses) - 1)
        pose = alignment.poses[-1] @ step.fraction(rest_s / step_s)
        return TwinPose(pose, float(alignment.times_s[-1]) + rest_s)

    def sensor(
        self, sweeps: AlignedSweeps, number: int, response: Response | None
    ) -> SensorModel | None:
        """Return a sensor with the recorded rings and rotation, or None if there are no rings.

        The azimuth step is determined from the sweep `number`.
        """
        recorded = sweeps.recorded
        lasers = recorded.lasers
        if not len(lasers):
            return None
        ring_offsets = _significant_offsets(sweeps.alignment.ring_offsets)
        known: dict[str, Any] = {}
        if self.rotation is not None:
            zero_deg = round(self.rotation.start_deg, 2) % 360
            known = {"clockwise": self.rotation.is_clockwise, "zero_deg": zero_deg}
        return SensorModel(
            name="Recorded sensor",
            sources={"angles": "median angles of the recorded points"}
            | _origin_sources(lasers)
            | _blocked_sources(sweeps.coverage.blocked),
            **known,
            firings_per_turn=firings_per_turn(recorded.read(number), recorded.lasers),
            rate_hz=self.rate_hz,
            range_m=(0.0, float(np.ceil(1.1 * sweeps.coverage.max_range_m))),
            beams=_beam_table(lasers, ring_offsets, response, sweeps.coverage.blocked),
            optics=_optics(response),
            performance=_range_biases(ring_offsets),
        )


def _significant_offsets(ring_offsets: Floats) -> Floats:
    """Return the ring offsets of an alignment, or zeros if most of them are small.

    A sensor without errors has a few large offsets, of rings that meet only level ground.
    """
    typical = np.median(np.abs(ring_offsets), axis=0)
    is_significant = (typical >= _MIN_RING_OFFSETS).any()
    return ring_offsets if is_significant else np.zeros_like(ring_offsets)


def _beam_table(
    lasers: RingLasers,
    ring_offsets: Floats,
    response: Response | None,
    blocked: BlockedDirections,
) -> dict[str, Any]:
    """Return the `beams` of a sensor model, from the lowest ring to the highest.

    `ring_offsets` are the significant ones of the alignment.
    """
    order = np.arange(len(lasers))[::-1]
    elevation_rad = lasers.elevation_rad + ring_offsets[:, 1]
    table = {"elevation_deg": np.degrees(elevation_rad[order]).round(_ANGLE_DECIMALS).tolist()}
    if ring_offsets[:, 2].any():
        azimuth_deg = np.degrees(ring_offsets[order, 2]).round(_ANGLE_DECIMALS)
        table["azimuth_deg"] = (azimuth_deg + 0.0).tolist()
    if not lasers.is_at_origin:
        forward = np.zeros(len(lasers))
        origins_m = lasers.positions(forward, lasers.elevation_rad[order], order)
        table["origin_m"] = (origins_m.round(_ORIGIN_DECIMALS) + 0.0).tolist()
    last = len(lasers) - 1
    sectors = [(last - ring, start, stop) for ring, start, stop in blocked.sectors_deg()]
    if sectors:
        table["blocked_deg"] = sorted(sectors)
    if response is not None and (response.by_ring != 1).any():
        table["intensity_factor"] = response.by_ring[order].tolist()
        table["intensity_range_m"] = RANGES_M.tolist()
    return table


def _optics(response: Response | None) -> dict[str, Any]:
    """Return the `optics` of a sensor model with the given response."""
    return {} if response is None else {"incidence_exponent": response.incidence_exponent}


def _range_biases(ring_offsets: Floats) -> dict[str, Any] | None:
    """Return the `performance` of a sensor whose rings have range errors, or None without errors.

    The errors are from the lowest ring to the highest. The alignment subtracts them from the
    recorded ranges.
    """
    biases_m = (-ring_offsets[::-1, 0]).round(_ORIGIN_DECIMALS) + 0.0
    return {"channel_bias_m": biases_m.tolist()} if biases_m.any() else None


def _origin_sources(lasers: RingLasers) -> dict[str, str]:
    """Return the source of the laser positions, if these are known."""
    if lasers.is_at_origin:
        return {}
    return {"origins": "angles of the recorded points as a function of the range"}


def _blocked_sources(blocked: BlockedDirections) -> dict[str, str]:
    """Return the source of the blocked directions, if there are any."""
    if not blocked.cells.any():
        return {}
    return {"blocked": "directions in which surfaces at close range are interrupted"}


class FittedSensor(NamedTuple):
    """A sensor with noise."""

    model: SensorModel
    range_noise: RangeNoise | None  # None if unknown
    notes: list[str]


def fit_sensor(
    sweeps: AlignedSweeps,
    sizes: Mapping[int, int],
    scene: Scene,
    response: Response | None,
    sensor: SensorModel | None,
) -> FittedSensor:
    """Fit a sensor's noise to its pulses that hit reconstructed surfaces.

    The range noise is determined from neighboring returns on planes instead, because differences to
    the reconstructed surfaces contain errors of the map. The detection threshold and random losses
    are omitted, because the map already contains their effects.

    Parameters
    ----------
    sweeps
        Aligned sweeps.
    sizes
        Number of points by sweep number, for the sweeps that may be read.
    scene
        The reconstructed surfaces.
    response
        Response of the sensor, or None if there are no intensities.
    sensor
        The sensor without noise. It must not be None if the recording has no rings.

    Returns
    -------
    FittedSensor
        The sensor with noise, and notes for the user.
    """
    assert sensor is not None
    if not len(sweeps.recorded.elevation_rad):
        note = "without rings, the sensor noise is that of the sensor model"
        return FittedSensor(sensor, None, [note])
    chosen = _sweeps_to_fit(sweeps.recorded, sizes)
    noise = estimate_range_noise(sweeps, chosen.tolist())
    stated = {} if sensor.performance is None else _stated(sensor.performance)
    notes = []
    try:
        fitted = _fit_to_sweeps(sweeps, chosen, scene, response)
    except LidarError as error:  # The reconstruction is usable without fitted noise.
        known = "is unknown" if noise is None else "is unknown except for that of the ranges"
        notes = [f"the sensor noise {known}: {error}"]
    else:
        if fitted.model.performance is not None:
            biases = {name: value for name, value in stated.items() if name == "channel_bias_m"}
            found = _stated(fitted.model.performance)
            stated = biases | {
                name: value for name, value in found.items() if name not in _DETECTION
            }
    if noise is not None:  # without the errors of the map
        stated = {name: value for name, value in stated.items() if name not in _RANGE_NOISE}
        stated["range_m"] = round(noise.range_m, _NOISE_DECIMALS)
    if not stated:
        return FittedSensor(sensor, noise, notes)
    count = plural(len(chosen), "sweep")
    source = f"fitted by lidarpool {__version__} to {Path(sweeps.name).name}, {count}"
    changes = {"performance": stated, "sources": {**sensor.sources, "performance": source}}
    return FittedSensor(SensorModel.model_validate(sensor.model_dump() | changes), noise, notes)


def _sweeps_to_fit(recorded: RecordedSweeps, sizes: Mapping[int, int]) -> Ints:
    """Return the numbers of the sweeps to which the noise is fitted, given the point counts."""
    # A sweep with few points, for example due to lost packets, would look as if it came from a
    # different sensor.
    counts = np.array([*sizes.values()])
    whole = np.array([*sizes])[counts >= np.median(counts) / 2]
    some = whole[even_indices(len(whole), 2 * _FIT_SWEEPS)]
    # Motion-compensated sweeps may be tilted relative to the sensor, in which case their rings are
    # not cones.
    spread_rad = [recorded.cone_spread_rad(number) for number in some.tolist()]
    return np.sort(some[np.argsort(spread_rad, kind="stable")[:_FIT_SWEEPS]])


def _stated(performance: Performance) -> dict[str, Any]:
    """Return the values of the performance that differ from the defaults."""
    return performance.model_dump(exclude_defaults=True)


def _fit_to_sweeps(
    sweeps: AlignedSweeps, chosen: Ints, scene: Scene, response: Response | None
) -> Fit:
    """Fit a sensor to the selected sweeps, or raise LidarError if this is not possible.

    Points as fired have a firing pose for each pulse. Motion-compensated points have none, so their
    rings are blurred, and parallax at close objects looks like lost pulses.
    """
    are_energies = response is not None and response.model is IntensityModel.ENERGIES
    white = None if response is None else response.white
    recording = _AlignedRecording(sweeps, chosen, white if are_energies else None, are_energies)
    pose = recording.load_poses() if recording.is_compensated else None
    return fit(recording, scene=scene, pose=pose, white=None if are_energies else white)


class _AlignedRecording(Recording):
    """Aligned sweeps, as fired or compensated for motion.

    Parameters
    ----------
    sweeps
        The sweeps.
    chosen
        Numbers of the sweeps of the recording, of shape (n,).
    white
        Intensity that is converted to the energy 1, or None to keep intensities.
    are_energies
        Whether intensities are energies after this conversion.
    """

    def __init__(
        self, sweeps: AlignedSweeps, chosen: Ints, white: float | None, are_energies: bool
    ) -> None:
        recorded = sweeps.recorded
        # The pulses of lasers at different positions have firing poses of their own.
        self.is_compensated = (
            sweeps.alignment.motion is Motion.COMPENSATED and recorded.lasers.is_at_origin
        )
        super().__init__(
            RecordingInfo(
                sweeps.name,
                energy_unit=1.0 if are_energies else None,
                has_firing_poses=not self.is_compensated,
                noise_classes=None,
            )
        )
        self._aligned = sweeps
        self._chosen = chosen
        self._white = white

    def __len__(self) -> int:
        return len(self._chosen)

    def load(self, number: int) -> Sweep:
        if not self.is_compensated:
            return self.load_fired(number)
        stored_number = int(self._chosen[number])
        sweep = self._aligned.recorded.read(stored_number)
        return self._with_points(sweep, self._aligned.align(sweep, stored_number).points)

    def load_fired(self, number: int) -> Sweep:
        stored_number = int(self._chosen[number])
        sweep = self._aligned.recorded.read(stored_number)
        as_fired = self._aligned.alignment.points_as_fired(sweep, stored_number)
        assert as_fired is not None
        points, firing_poses = as_fired
        return self._with_points(sweep, points).replace(firing_poses=firing_poses)

    def load_poses(self) -> Floats:
        return self._aligned.alignment.poses[self._chosen]

    def _with_points(self, sweep: Sweep, points: Floats) -> Sweep:
        intensity = sweep.intensity
        if intensity is not None:  # convert to energy, where white at 10 m is 1
            intensity = intensity / (self._white or 1)
        channel = self._aligned.recorded.ring_count - 1 - sweep.columns["row"]
        return sweep.with_columns(channel=channel, intensity=intensity).replace(points=points)
