"""Resample recorded sweeps to another sensor whose rays lie within the recorded resolution.

No surface is interpolated. For each pulse of the other sensor, the recorded pulse with the closest
direction is used, and its returns keep their exact positions, times and other values. Directions
therefore differ from those of the other sensor by up to half of the recorded spacing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarfiles.clouds.recording import Recording
from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.numerics.elementary import arcsin, arctan2
from lidarsim.sensor.sensor import Sensor
from lidarsim.words import format_rounded, list_names, plural

from .augmented_sweep import AugmentedSweep
from .nearest_pulse_loops import CandidateRings
from .ring_directions import RingDirections

_SLACK = 1.05  # tolerance of the checks, because recorded directions are measured
_MAX_MISSING = 0.02  # maximum share of rays, or of rays in a channel, that cannot be resampled
_MIN_STEP_SHARE = 0.97  # minimum azimuth step of a sensor, as a multiple of the recorded step
_MAX_SHARED = 0.05  # maximum share of rays whose closest pulse is also closest to another ray
_PARTIAL_HINT = "Use `--partial` to omit such pulses."
_TWIN_HINT = (
    "To simulate this sensor in a scene that is reconstructed from the recording, use `lidarpool "
    "twin`."
)
_SAME_CHANNEL_RAD = np.radians(0.01)  # Channels with a smaller elevation difference are equal.


class SensorResampler:
    """Resamples the sweeps of a recording to the rays of another sensor.

    For each pulse in one revolution of the other sensor, the recorded pulse with the closest
    direction is determined: of the rings around the elevation of the pulse, the ring with the
    smallest elevation difference, and in this ring the pulse with the smallest azimuth difference.
    Neither difference may exceed half of the recorded spacing, apart from the scatter of the
    measured elevations within a ring. If the recorded pulse has a return, the point is copied with
    all of its columns. If it has none, the resampled pulse has none either. All returns of a pulse
    are copied, and each return is used at most once.

    The result therefore contains no interpolated positions, but its directions differ from those of
    the other sensor by up to half of the recorded spacing. Directions are measured from the origin
    of the recorded points, so the offsets of the other sensor's beams from its origin are ignored.
    In motion-compensated sweeps, the recorded spacing varies. Where it is wider than that of the
    other sensor, two rays may be closest to the same pulse. The farther ray then has no return.
    Results of lidarpool also contain the directions before the compensation, which are used.
    The revolution always starts at the azimuth at which the other sensor starts, but all points
    keep their recorded times. The detection range of the other sensor is not simulated. Only
    returns outside its `min_range_m` and `max_range_m` are removed.

    Parameters
    ----------
    recording
        Recording of a sensor with rings.
    sensor
        The other sensor. It may have fewer channels, a narrower field of view and fewer azimuths
        than the recorded sensor. An infinite `max_range_m` keeps the recorded maximum range.
    recorded_sensor
        Model of the recorded sensor, if it is known. Rings that never return, for example because
        they point to the sky, are only known from the model. It is also used to check the maximum
        range.
    partial
        Whether to omit pulses that cannot be resampled because their directions are outside the
        recorded field of view or between distant rings. By default, they are an error.

    Attributes
    ----------
    notes
        Sentences for the user.

    Raises
    ------
    LidarError
        If the recording cannot be read, has no rings, or does not have the field of view, the
        resolution or the maximum range of the sensor.

    Examples
    --------
    >>> from lidarpool import Pose, Scanner, Scene, SweepsInMemory, box
    >>> room = Scene.from_meshes([box("Room", (30, 20, 4))])
    >>> recorded = Sensor.grid(720, 32, vertical_fov_deg=30)
    >>> scanner = Scanner(room, recorded, columns=["channel"], coordinates="sensor")
    >>> cloud = scanner.sweep(Pose([0, 0, 2]))
    >>> sweep = Sweep(cloud.positions, {"channel": cloud["channel"]})
    >>> recording = SweepsInMemory("drive", [sweep])
    >>> resampler = SensorResampler(recording, Sensor.grid(360, 8, vertical_fov_deg=20))
    >>> len(sweep), len(resampler.sweep(0).sweep)
    (23040, 2880)
    """

    def __init__(
        self,
        recording: Recording,
        sensor: Sensor,
        *,
        recorded_sensor: Sensor | None = None,
        partial: bool = False,
    ) -> None:
        self.recording = recording
        self.sensor = sensor
        silent_rad = None if recorded_sensor is None else _silent_rad(recording, recorded_sensor)
        self._pulses = RingDirections(recording, silent_rad)
        self.notes: list[str] = []
        self._check_range(recorded_sensor)
        rays, candidates = _matched_rays(self._pulses, sensor)
        fits = self._fitting(rays, partial=partial)
        self._rays, self._candidates = _select(rays, candidates, fits)
        self._check_azimuths()
        self._check_sharing()
        self._add_notes()

    def _check_range(self, recorded_sensor: Sensor | None) -> None:
        max_range_m = self.sensor.max_range_m
        if max_range_m == float("inf"):
            return
        if recorded_sensor is not None:
            if max_range_m > recorded_sensor.max_range_m:
                raise LidarError(
                    f"The maximum range of {self.sensor.model} is {max_range_m:g} m, but that of "
                    f"{recorded_sensor.model} in {self.recording.info.name} is only "
                    f"{recorded_sensor.max_range_m:g} m. Use a sensor file with a lower "
                    f"`max_range_m`. {_TWIN_HINT}"
                )
        elif max_range_m > self._pulses.max_range_m:
            self.notes.append(
                f"The maximum range of {self.sensor.model} is {max_range_m:g} m, but the returns "
                f"in {self.recording.info.name} only reach {self._pulses.max_range_m:.0f} m. "
                "Surfaces beyond the maximum range of the recorded sensor are missing."
            )

    def _fitting(self, rays: _Rays, *, partial: bool) -> Bools:
        """Return which rays can be resampled.

        Channels of a spinning sensor are either complete in elevation or omitted. Raises LidarError
        if rays would be omitted, unless `partial` is true.
        """
        outside = self._incomplete_channels(rays, rays.is_outside)
        distant = self._incomplete_channels(rays, rays.is_outside | rays.is_distant)
        if not partial:
            self._check_elevations(rays, np.flatnonzero(outside), np.flatnonzero(distant))
            if rays.is_beside.mean() > _MAX_MISSING:
                raise LidarError(
                    f"The horizontal field of view of {self.recording.info.name} is "
                    f"{np.degrees(self._pulses.view_rad[1]):.0f}°, and does not contain that of "
                    f"{self.sensor.model}. {_PARTIAL_HINT} {_TWIN_HINT}"
                )
        fits = ~(rays.is_outside | rays.is_distant | rays.is_beside)
        if _is_spinning(self.sensor):
            fits &= ~distant[rays.channel]
        if not fits.any():
            raise LidarError(
                f"No pulse of {self.sensor.model} lies within the field of view and the resolution "
                f"of {self.recording.info.name}. {_TWIN_HINT}"
            )
        missing = 1 - fits.mean()
        if missing > _MAX_MISSING:
            remaining = len(np.unique(rays.channel[fits]))
            self.notes.append(
                f"{100 * missing:.0f} % of the pulses of {self.sensor.model} are outside the field "
                f"of view or between the rings of {self.recording.info.name} and are omitted. "
                f"{remaining} of {plural(self.sensor.channels, 'channel')} remain."
            )
        return fits

    def _incomplete_channels(self, rays: _Rays, is_missing: Bools) -> Bools:
        counts = np.bincount(rays.channel, minlength=self.sensor.channels)
        missing = np.bincount(rays.channel, is_missing, minlength=self.sensor.channels)
        return np.asarray(missing > _MAX_MISSING * counts)

    def _check_elevations(self, rays: _Rays, outside: Ints, distant: Ints) -> None:
        """Raise LidarError if channels are outside the field of view or far from all rings."""
        model, name = self.sensor.model, self.recording.info.name
        top_deg, bottom_deg = np.degrees(self._pulses.elevation_rad[[0, -1]])
        if len(outside) and not _is_spinning(self.sensor):
            low_deg, high_deg = np.degrees([rays.elevation.min(), rays.elevation.max()])
            raise LidarError(
                f"The pulses of {model} have elevations from {low_deg:.1f}° to {high_deg:.1f}°, "
                f"but {100 * rays.is_outside.mean():.0f} % of them are outside the vertical field "
                f"of view of {name} ({bottom_deg:.1f}° to {top_deg:.1f}°). {_PARTIAL_HINT} "
                f"{_TWIN_HINT}"
            )
        if len(outside):
            listed = list_names([f"{self._elevation_deg(rays, k):.1f}°" for k in outside])
            raise LidarError(
                f"{model} has channels at {listed}, which are outside the vertical field of view "
                f"of {name} ({bottom_deg:.1f}° to {top_deg:.1f}°). {_PARTIAL_HINT} {_TWIN_HINT}"
            )
        if len(distant):
            offset_deg = np.degrees(np.median(rays.offset[rays.channel == distant[0]]))
            raise LidarError(
                f"{model} has a channel at {self._elevation_deg(rays, distant[0]):.1f}°, but the "
                f"closest ring of {name} is {offset_deg:.1f}° away. {_PARTIAL_HINT} {_TWIN_HINT}"
            )

    @staticmethod
    def _elevation_deg(rays: _Rays, channel: int) -> float:
        return float(np.degrees(np.median(rays.elevation[rays.channel == channel])))

    def _check_azimuths(self) -> None:
        """Raise LidarError if a spinning sensor has a finer azimuth resolution."""
        if not _is_spinning(self.sensor):
            return
        rays = self._rays
        channel = rays.channel[0]
        own = np.sort(rays.azimuth[rays.channel == channel])
        step_rad = float(np.median(np.diff(own)))
        recorded_rad = float(self._pulses.step_rad[rays.ring].max())
        if step_rad < _MIN_STEP_SHARE * recorded_rad:
            raise LidarError(
                f"The azimuth resolution of {self.sensor.model} is "
                f"{format_rounded(np.degrees(step_rad))}°, but that of {self.recording.info.name} "
                f"is only {format_rounded(np.degrees(recorded_rad))}°. Use a sensor with fewer "
                f"firings per revolution. {_TWIN_HINT}"
            )

    def _check_sharing(self) -> None:
        """Raise LidarError if many rays are closest to the same recorded pulses."""
        rays = self._rays
        column = np.floor((rays.azimuth + np.pi) / self._pulses.step_rad[rays.ring])
        cell = rays.ring * 2**32 + column.astype(np.int64)
        shared = 1 - len(np.unique(cell)) / len(cell)
        if shared > _MAX_SHARED:
            raise LidarError(
                f"{100 * shared:.0f} % of the rays of {self.sensor.model} are closer to each other "
                f"than the pulses in {self.recording.info.name}. {_TWIN_HINT}"
            )

    def _add_notes(self) -> None:
        rays = self._rays
        vertical_deg = np.degrees(np.quantile(rays.offset, 1 - _MAX_MISSING))
        horizontal_deg = np.degrees(np.median(self._pulses.step_rad[rays.ring])) / 2
        self.notes.append(
            f"Points are recorded points. Their directions differ from the rays of "
            f"{self.sensor.model} by up to {format_rounded(vertical_deg, 2)}° vertically and "
            f"{format_rounded(horizontal_deg, 2)}° horizontally."
        )

    def sweep(self, number_or_sweep: int | Sweep) -> AugmentedSweep:
        """Resample a sweep.

        Parameters
        ----------
        number_or_sweep
            Number of a sweep in the recording, or a sweep that was read from it.

        Returns
        -------
        AugmentedSweep
            Copies of recorded returns, in the order of the recording. `channel` contains the
            channels of the other sensor.

        Raises
        ------
        LidarError
            If the recording cannot be read.
        """
        sweep = number_or_sweep
        if not isinstance(sweep, Sweep):
            sweep = self.recording[sweep]
        rays = self._rays
        rows, ray = self._pulses.closest(sweep, rays.azimuth, rays.elevation, self._candidates)
        range_m = np.linalg.norm(np.asarray(sweep.points[rows], np.float64), axis=1)
        measured = (range_m >= self.sensor.min_range_m) & (range_m <= self.sensor.max_range_m)
        return _copied_returns(sweep, rows[measured], rays.channel[ray[measured]])


def _copied_returns(sweep: Sweep, rows: Ints, channel: Ints) -> AugmentedSweep:
    """Create a sweep that consists of some recorded returns with new channels.

    Parameters
    ----------
    sweep
        Recorded sweep.
    rows
        Ascending rows of the returns, with shape (n,).
    channel
        New channel of each return, with shape (n,).
    """
    copied = sweep.select(rows)
    columns = {**copied.columns, "channel": channel.astype(np.uint16)}
    columns.setdefault("cause", np.zeros(len(rows), np.uint8))
    return AugmentedSweep(copied.replace(columns=columns), rows, np.ones(len(rows), bool))


class _Rays(NamedTuple):
    """Rays of one revolution of a sensor, matched with recorded rings.

    All arrays have shape (k,).
    """

    azimuth: Floats  # radians, -pi to pi
    elevation: Floats  # radians
    channel: Ints
    ring: Ints  # recorded ring with the closest elevation
    offset: Floats  # elevation difference to this ring, radians
    is_outside: Bools  # whether the ray is above or below the recorded rings
    is_distant: Bools  # whether the ring belongs to another channel
    is_beside: Bools  # whether the ray is outside the horizontal field of view


def _select(rays: _Rays, candidates: CandidateRings, chosen: Bools) -> tuple[_Rays, CandidateRings]:
    return (
        _Rays._make(array[chosen] for array in rays),
        CandidateRings._make(array[chosen] for array in candidates),
    )


def _matched_rays(pulses: RingDirections, sensor: Sensor) -> tuple[_Rays, CandidateRings]:
    """Match the rays of the first revolution of a sensor with recorded rings."""
    firings = np.array(sensor.firings_of_revolution(0))
    directions = sensor.directions(firings)
    limits_rad = _channel_limits(sensor)
    rays = []
    candidates = []
    for channel in range(sensor.channels):
        passed = ~sensor.is_blocked(firings, np.full(len(firings), channel))
        matched = _match_channel(pulses, directions[passed, channel], channel, limits_rad[channel])
        rays.append(matched[0])
        candidates.append(matched[1])
    width = max(part.expected.shape[1] for part in candidates)
    candidates = [
        part._replace(expected=np.pad(part.expected, ((0, 0), (0, width - part.expected.shape[1]))))
        for part in candidates
    ]
    return (
        _Rays._make(np.concatenate(arrays) for arrays in zip(*rays, strict=True)),
        CandidateRings._make(np.concatenate(arrays) for arrays in zip(*candidates, strict=True)),
    )


def _match_channel(
    pulses: RingDirections, directions: Floats, channel: int, limit_rad: float
) -> tuple[_Rays, CandidateRings]:
    """Match the rays of a channel with recorded rings.

    A ray matches the closest ring if the elevation difference is at most half of the spacing
    between the rings around it, and at most `limit_rad`.
    """
    azimuth = np.ascontiguousarray(arctan2(directions[:, 1], directions[:, 0]))
    elevation = arcsin(np.clip(directions[:, 2], -1, 1))
    rings = pulses.elevations_at(azimuth)
    distance = np.abs(rings - elevation[:, None])
    offset = distance.min(axis=1)
    half = _half_spacings(rings, elevation)
    rays = _Rays(
        azimuth,
        elevation,
        channel=np.full(len(azimuth), channel),
        ring=distance.argmin(axis=1),
        offset=offset,
        is_outside=offset > _SLACK * half + pulses.spread_rad,
        is_distant=offset > _SLACK * limit_rad,
        is_beside=~pulses.is_in_view(azimuth),
    )
    # The direction of a return may differ from that of its ring, for example at close range.
    tolerance = np.minimum(half + pulses.spread_rad, _SLACK * limit_rad)
    is_near = distance <= np.maximum(tolerance + pulses.spread_rad, offset)[:, None]
    first = is_near.argmax(axis=1)
    count = is_near.shape[1] - is_near[:, ::-1].argmax(axis=1) - first
    most = count.max(initial=1)
    listed = np.minimum(first[:, None] + np.arange(most), is_near.shape[1] - 1)
    expected = np.take_along_axis(rings, listed, axis=1)
    return rays, CandidateRings(first, count, expected, tolerance)


def _half_spacings(rings: Floats, elevation: Floats) -> Floats:
    """Return half of the spacing between the rings around each ray in radians, with shape (k,).

    `rings` are the elevations of all rings at each ray, with shape (k, r). For rays above or below
    all rings, the spacing is that of the outermost rings.
    """
    above = rings - elevation[:, None]
    # The spacing at the elevation of a ring is that to the next ring above it.
    to_above = np.where(above > 0, above, np.inf).min(axis=1)
    to_below = np.where(above <= 0, -above, np.inf).min(axis=1)
    half = np.maximum((to_above + to_below) / 2, np.minimum(to_above, to_below))
    half = np.where(np.isinf(to_above), np.abs(rings[:, 0] - rings[:, 1]) / 2, half)
    return np.where(np.isinf(to_below), np.abs(rings[:, -1] - rings[:, -2]) / 2, half)


def _is_spinning(sensor: Sensor) -> bool:
    """Return whether each channel of a sensor has a constant elevation."""
    return sensor.spins(np.arange(1)) is not None and sensor.axes is None


def _channel_limits(sensor: Sensor) -> Floats:
    """Return half of each channel's spacing to its neighbors in radians, or inf if there is none.

    Closer rings belong to the channel and not to its neighbors.
    """
    if not _is_spinning(sensor):
        return np.full(sensor.channels, np.inf)
    elevation = sensor.beams.elevation
    distance = np.abs(elevation[:, None] - elevation)
    return np.asarray(np.where(distance > _SAME_CHANNEL_RAD, distance, np.inf).min(axis=1) / 2)


def _silent_rad(recording: Recording, recorded_sensor: Sensor) -> Floats:
    """Return the elevations of the channels above and below all rings that have returns."""
    known = recording.rings.elevation_rad
    if not len(known) or not _is_spinning(recorded_sensor):
        return np.empty(0)
    elevation = recorded_sensor.beams.elevation
    limits = _channel_limits(recorded_sensor)
    is_silent = (elevation > known[0] + limits) | (elevation < known[-1] - limits)
    return elevation[is_silent]
