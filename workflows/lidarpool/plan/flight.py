"""Plan flight lines of an airborne survey, and the speed and rates that a density requires.

The swath of a line is 2 h tan(FOV / 2) for a height h above ground, and the density of a strip is
the pulse rate divided by the speed and the swath (Baltsavias 1999).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.motion.trajectory import CENTER, Pose
from lidarsim.numerics.arrays import Floats
from lidarsim.numerics.vectors import rotate
from lidarsim.scene.scene import Scene
from lidarsim.scene.simplified import SimplifiedScene
from lidarsim.schema.checks import check_number
from lidarsim.sensor import Sensor
from lidarsim.sensor.beams import Mirror
from lidarsim.sensor.models import load_sensor, read_model
from lidarsim.sensor.sensor import LineSensor
from lidarsim.survey.survey import MAX_SENSORS
from lidarsim.words import plural
from raybeam import RayCaster

from .flight_path import FlightPath, Leg, fly

Kind = Literal["line", "cross"]

SPEEDS_M_S = (3.0, 70.0)  # default limits of the speed over ground
WIDE_FOV_DEG = 90.0  # field of view that is planned for scanners with a wider one
DOWN = Pose((0.0, 0.0, 0.0), pitch_deg=90)  # mount of sensors whose z axis is the axis of rotation
_SAMPLED_PULSES = 50_000
_ACROSS = 9  # number of ground samples across the swath
_ALONG = 400  # maximum number of ground samples along a line
_QUANTILES = (0.05, 0.95)  # of the height above ground, for the spacing and for the speed
_MARGIN_M = 2.0  # distance by which a line extends beyond the area


@dataclass(frozen=True)
class Scanner:
    """A scanner that looks down from an aircraft, with the limits of its rates.

    Parameters
    ----------
    model
        Name of the sensor model, or path of a sensor file.
    sensor
        The sensor at its nominal rates.
    mount
        Pose of the sensor in the frame of the aircraft.
    half_fov_deg
        Half of the planned field of view across the track, in degrees.
    pulses_hz
        Maximum number of pulses per second within the planned field of view, averaged over a cycle.
    fired_hz
        Maximum number of pulses per second, averaged over a cycle.
    ahead
        Tangent of the largest angle between the nadir and a ray along the track.
    lines_per_cycle
        Number of scan lines in a cycle of the scanner.
    rates_hz
        Minimum and maximum number of cycles per second. Both are equal if the rate is fixed.
    has_pulse_count
        Whether the number of pulses per cycle can be set.
    """

    model: str
    sensor: Sensor
    mount: Pose
    half_fov_deg: float
    pulses_hz: float
    fired_hz: float
    ahead: float
    lines_per_cycle: int
    rates_hz: tuple[float, float]
    has_pulse_count: bool

    @classmethod
    def load(cls, model: str, fov_deg: float | None = None) -> Scanner:
        """Load a sensor model and determine its field of view and rates.

        Sensors whose head rotates about the z axis, and sensors that look forward, are mounted with
        their x axis down.

        Raises
        ------
        LidarError
            If the sensor emits no pulses downward, or if its field of view is narrower than
            `fov_deg`.
        """
        content = read_model(model)
        sensor = load_sensor(model)
        mount = CENTER if isinstance(sensor, LineSensor) else DOWN
        steps = sensor.steps_of_revolution(0)
        first, stop = sensor.firings(steps[0])[0], sensor.firings(steps[-1])[1]
        cycle_s = (sensor.revolution_start_ns(1) - sensor.revolution_start_ns(0)) / 1e9
        count = min(stop - first, max(1, _SAMPLED_PULSES // sensor.channels))
        firings = np.linspace(first, stop, count, endpoint=False).astype(np.int64)
        directions = rotate(sensor.directions(firings).reshape(-1, 3), mount.rotation)
        x, y, z = directions.T
        across_deg = np.degrees(np.arctan2(np.abs(y), -z))
        widest_deg = 2 * float(across_deg[across_deg < 90].max(initial=0.0))
        if not widest_deg > 0:
            raise LidarError(
                f"{sensor.model} emits no pulses across the flight direction. Use an airborne "
                "scanner, such as airborne/riegl-vq780i."
            )
        if fov_deg is not None and fov_deg > widest_deg + 0.1:
            raise LidarError(
                f"`--fov` is {fov_deg:g}°, but the field of view of {sensor.model} across the "
                f"flight direction is {widest_deg:.4g}°. Reduce `--fov`."
            )
        planned_deg = min(widest_deg, WIDE_FOV_DEG) if fov_deg is None else fov_deg
        within = across_deg <= planned_deg / 2 + 1e-6
        fired_hz = (stop - first) * sensor.channels / cycle_s
        head = sensor.head
        is_mirror = isinstance(head, Mirror)
        oscillates = is_mirror and head.motion != "sawtooth"
        can_turn_at = is_mirror or content.firing_us is not None
        fixed = (content.rate_hz, content.rate_hz)
        return cls(
            model=model,
            sensor=sensor,
            mount=mount,
            half_fov_deg=planned_deg / 2,
            pulses_hz=fired_hz * float(within.mean()),
            fired_hz=fired_hz,
            ahead=float(np.abs(x[within] / z[within]).max()),
            lines_per_cycle=2 if oscillates else sensor.channels,
            rates_hz=(content.rates_hz or fixed) if can_turn_at else fixed,
            has_pulse_count=is_mirror and content.firings_per_turn is not None,
        )

    @property
    def tangent(self) -> float:
        """Half of the swath divided by the height above ground."""
        return math.tan(math.radians(self.half_fov_deg))

    def swath_m(self, height_m: float) -> float:
        """Return the width of the swath at a height above level ground, in meters."""
        return 2 * height_m * self.tangent


class Ground:
    """Ground of a survey, which is a scene or, without a scene, level at a height of 0."""

    def __init__(self, scene: Scene | None = None) -> None:
        self._scene = None
        if scene is not None:
            self._scene = replace(SimplifiedScene.from_scene(scene).scene, actors=())
            self._caster = RayCaster(self._scene.vertices, self._scene.faces)

    def heights(self, points: Floats) -> Floats:
        """Return the heights of the highest surfaces at horizontal positions.

        For `points` of shape (n, 2) in world coordinates, the result has shape (n,). It is NaN
        where there is no ground.
        """
        if self._scene is None:
            return np.zeros(len(points))
        top_m = float(self._scene.bounds[1, 2]) + 1
        origins = np.column_stack([points - self._scene.origin[:2], np.full(len(points), top_m)])
        hits = self._caster.cast(origins, np.tile([0.0, 0.0, -1.0], (len(points), 1)))
        heights = np.where(hits.hit, top_m - hits.distance, np.nan)
        return np.asarray(heights + self._scene.origin[2])


class FlightLine(NamedTuple):
    """A flight line that covers a strip of the area."""

    name: str
    kind: Kind
    leg: Leg
    clearance_m: tuple[float, float, float]  # minimum, mean and maximum height above ground
    swath_m: tuple[float, float]  # at the minimum and the maximum height above ground


@dataclass(frozen=True, eq=False)
class FlightPlan:
    """Flight lines with the speed and the rates of the scanner.

    Heights and positions are in world coordinates, in meters.
    """

    area: Any  # polygon of shapely
    scanner: Scanner
    lines: tuple[FlightLine, ...]
    path: FlightPath
    speed_m_s: float
    rate_hz: float  # cycles per second
    pulses_hz: float  # pulses per second within the planned field of view
    fired_hz: float  # pulses per second
    pulses_per_cycle: int | None  # number of firings per cycle, or None if it is fixed
    spacing_m: float | None  # distance between adjacent lines, or None for a single line
    agl_m: float
    overlap: float  # requested overlap, 0 to 1
    min_overlap: float | None  # overlap of adjacent lines over the highest ground
    density_m2: float | None  # requested density
    densities_m2: tuple[float, float]  # densities of a strip over the lowest and highest ground
    along_m: float  # mean distance between scan lines
    across_m: float  # mean distance between the pulses of a scan line
    missing: float  # share of the samples without ground
    notes: tuple[str, ...] = ()  # requirements that are not met, and how to meet them

    @property
    def duration_s(self) -> float:
        """Time in the air in seconds, including turns."""
        return float(self.path.times_s[-1])

    @property
    def length_m(self) -> float:
        """Total length of the flight lines in meters."""
        return sum(line.leg.length_m for line in self.lines)


class _Strips(NamedTuple):
    """Flight lines before their speed is known."""

    lines: list[FlightLine]
    clearances_m: Floats  # all heights above ground, without NaN
    spacing_m: float | None
    missing: float


def plan_flight(
    area: Any,
    ground: Ground,
    scanner: Scanner,
    *,
    agl_m: float,
    overlap: float = 0.3,
    density_m2: float | None = None,
    speeds_m_s: tuple[float, float] = SPEEDS_M_S,
    heading_deg: float | None = None,
    cross: int = 0,
    follow: bool = False,
) -> FlightPlan:
    """Plan the flight lines that cover an area.

    The lines are parallel to the longest side of the area. Their spacing results in the overlap at
    the 5 % quantile of the heights above ground, and their speed in the density at the 95 %
    quantile.

    Parameters
    ----------
    area
        Polygon or multipolygon of shapely, in world coordinates in meters.
    ground
        Ground of the survey.
    scanner
        The scanner.
    agl_m
        Height above ground in meters. Without `follow`, each line is level at this height above the
        mean ground.
    overlap
        Overlap of adjacent strips as a fraction of the swath, in [0, 0.95].
    density_m2
        Number of pulses per square meter in each strip. By default, the aircraft flies at the
        maximum speed, and the pulse rate is the maximum.
    speeds_m_s
        Minimum and maximum speed over ground in m/s.
    heading_deg
        Direction of the lines in degrees clockwise from north. By default, they are parallel to the
        longest side of the area.
    cross
        Number of cross strips, which are perpendicular to the other lines.
    follow
        Whether the aircraft follows the ground along each line.

    Raises
    ------
    LidarError
        If a value is out of range, if there is no ground below a line, if the ground is higher than
        the aircraft, or if there are too many lines.

    Examples
    --------
    >>> import shapely
    >>> scanner = Scanner.load("airborne/riegl-vq780i")
    >>> plan = plan_flight(shapely.box(0, 0, 2000, 900), Ground(), scanner, agl_m=700)
    >>> len(plan.lines), round(plan.scanner.swath_m(700))
    (2, 808)
    """
    check_number("agl_m", agl_m, gt=0, le=20_000)
    check_number("overlap", overlap, ge=0, le=0.95)
    check_number("cross", cross, whole=True, ge=0, le=MAX_SENSORS)
    if density_m2 is not None:
        check_number("density_m2", density_m2, gt=0, le=1e5)
    heading = _longest_side(area) if heading_deg is None else math.radians(90 - heading_deg)
    strips = _strips(area, ground, scanner, agl_m, agl_m, heading, overlap, cross, follow)
    lowest_m = float(np.quantile(strips.clearances_m, _QUANTILES[0]))
    if lowest_m < agl_m:  # the swath is narrower over high ground
        narrow_m = max(lowest_m, 0.05 * agl_m)
        strips = _strips(area, ground, scanner, agl_m, narrow_m, heading, overlap, cross, follow)
    low_m, high_m = np.quantile(strips.clearances_m, _QUANTILES).tolist()
    if not strips.clearances_m.min() > 0:
        raise LidarError(
            f"The ground rises {-strips.clearances_m.min():.0f} m above a flight line. Increase "
            "`--agl`, or follow the terrain with `--follow`."
        )
    speed_m_s, pulses_hz = _speed(scanner, scanner.swath_m(high_m), density_m2, speeds_m_s)
    rate_hz = _rate(scanner, scanner.swath_m(agl_m), speed_m_s, pulses_hz)
    fired_hz = scanner.fired_hz * pulses_hz / scanner.pulses_hz
    count = None
    if scanner.has_pulse_count:
        count = max(round(fired_hz / rate_hz / scanner.sensor.channels), 1)
        fired_hz = count * rate_hz * scanner.sensor.channels
        pulses_hz = scanner.pulses_hz * fired_hz / scanner.fired_hz
    lines_hz = rate_hz * scanner.lines_per_cycle
    overlap_m = None
    if strips.spacing_m is not None:
        overlap_m = 1 - strips.spacing_m / scanner.swath_m(float(strips.clearances_m.min()))
    plan = FlightPlan(
        area=area,
        scanner=scanner,
        lines=tuple(strips.lines),
        path=fly([line.leg for line in strips.lines], speed_m_s),
        speed_m_s=speed_m_s,
        rate_hz=rate_hz,
        pulses_hz=pulses_hz,
        fired_hz=fired_hz,
        pulses_per_cycle=count,
        spacing_m=strips.spacing_m,
        agl_m=agl_m,
        overlap=overlap,
        min_overlap=overlap_m,
        density_m2=density_m2,
        densities_m2=(
            pulses_hz / (speed_m_s * scanner.swath_m(high_m)),
            pulses_hz / (speed_m_s * scanner.swath_m(low_m)),
        ),
        along_m=speed_m_s / lines_hz,
        across_m=scanner.swath_m(agl_m) * lines_hz / pulses_hz,
        missing=strips.missing,
    )
    return replace(plan, notes=tuple(_shortfalls(plan, strips.clearances_m)))


def _longest_side(area: Any) -> float:
    """Return the direction of the longest side of the smallest rectangle around an area.

    The direction is in radians, counterclockwise from x, in (-π/2, π/2].
    """
    corners = np.array(area.minimum_rotated_rectangle.exterior.coords)[:4]
    sides = np.roll(corners, -1, axis=0) - corners
    x, y = max(sides.tolist(), key=lambda side: math.hypot(*side).__round__(6))
    angle = math.atan2(y, x)
    return angle - math.pi * math.ceil(angle / math.pi - 0.5)


def _strips(
    area: Any,
    ground: Ground,
    scanner: Scanner,
    agl_m: float,
    narrow_m: float,
    heading: float,
    overlap: float,
    cross: int,
    follow: bool,
) -> _Strips:
    """Place flight lines over an area.

    The swath at the height `narrow_m` above ground determines their spacing.
    """
    swath_m = scanner.swath_m(narrow_m)
    margin_m = _MARGIN_M + scanner.ahead * agl_m
    tracks = _tracks(area, heading, _offsets(area, heading, swath_m, overlap), swath_m, margin_m)
    crossing = heading + math.pi / 2
    crossed = _tracks(area, crossing, _even_offsets(area, crossing, cross), swath_m, margin_m)
    if len(tracks) + len(crossed) > MAX_SENSORS:
        raise LidarError(
            f"The area needs {len(tracks) + len(crossed)} flight lines, but the limit is "
            f"{MAX_SENSORS}. Increase `--agl` or `--fov`, reduce `--overlap`, or divide the area."
        )
    named = [(f"line-{n}", "line", track) for n, track in enumerate(tracks, 1)]
    named += [(f"cross-{n}", "cross", track) for n, track in enumerate(crossed, 1)]
    lines = []
    clearances = []
    missing = []
    for name, kind, (start, stop) in named:
        heights = _ground_below(ground, start, stop, scanner.swath_m(agl_m))
        missing.append(np.isnan(heights).mean())
        if np.isnan(heights).all():
            raise LidarError(
                f"There is no ground below {name}. Check that the area and the terrain have the "
                "same coordinate system, and that the terrain covers the area."
            )
        altitudes = _altitudes(heights, agl_m, float(np.hypot(*(stop - start))), follow)
        clearance = altitudes[:, None] - heights
        known = clearance[~np.isnan(clearance)]
        extremes = float(known.min()), float(known.mean()), float(known.max())
        swaths = scanner.swath_m(extremes[0]), scanner.swath_m(extremes[2])
        lines.append(FlightLine(name, kind, Leg(start, stop, altitudes), extremes, swaths))
        clearances.append(known)
    spacing_m = None
    if len(tracks) > 1:
        across = np.array([-math.sin(heading), math.cos(heading)])
        spacing_m = float(abs((tracks[1][0] - tracks[0][0]) @ across))
    return _Strips(lines, np.concatenate(clearances), spacing_m, float(np.mean(missing)))


def _limits(area: Any, heading: float) -> tuple[float, float]:
    """Return the extent of an area across a direction, in meters from the world origin."""
    points = np.concatenate([np.array(part.exterior.coords) for part in _parts(area)])[:, :2]
    across = points @ (-math.sin(heading), math.cos(heading))
    return float(across.min()), float(across.max())


def _parts(area: Any) -> list[Any]:
    return list(getattr(area, "geoms", [area]))


def _offsets(area: Any, heading: float, swath_m: float, overlap: float) -> Floats:
    """Return the offsets of lines across their direction, so that their strips cover the area."""
    low, high = _limits(area, heading)
    excess_m = high - low - swath_m
    if excess_m <= 0:
        return np.array([(low + high) / 2])
    count = math.ceil(excess_m / ((1 - overlap) * swath_m) - 1e-9) + 1
    if count > MAX_SENSORS:
        return np.zeros(count)
    return np.linspace(low + swath_m / 2, high - swath_m / 2, count)


def _even_offsets(area: Any, heading: float, count: int) -> Floats:
    """Return the offsets of `count` lines that are evenly distributed over an area."""
    low, high = _limits(area, heading)
    return low + (high - low) * (np.arange(count) + 0.5) / max(count, 1)


def _tracks(
    area: Any, heading: float, offsets: Floats, swath_m: float, margin_m: float
) -> list[tuple[Floats, Floats]]:
    """Return the starts and stops of lines that cover the parts of an area within their swaths.

    Consecutive lines have opposite directions.
    """
    if len(offsets) > MAX_SENSORS:
        raise LidarError(
            f"The area needs {len(offsets):,} flight lines, but the limit is {MAX_SENSORS}. "
            "Increase `--agl` or `--fov`, reduce `--overlap`, or divide the area."
        )
    ahead = np.array([math.cos(heading), math.sin(heading)])
    left = np.array([-ahead[1], ahead[0]])
    reach_m = float(np.abs(np.array(area.bounds)).max()) * 3 + 1
    tracks = []
    for offset in offsets.tolist():
        middle = offset * left
        corners = [
            middle + a * reach_m * ahead + b * swath_m / 2 * left
            for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        ]
        band = area.intersection(type(_parts(area)[0])([*map(tuple, corners)]))
        points = [
            np.array(part.exterior.coords)[:, :2]
            for part in _parts(band)
            if hasattr(part, "exterior")
        ]
        if not points:  # a gap between the polygons of a multipolygon
            continue
        along = np.concatenate(points) @ ahead
        ends = middle + (along.min() - margin_m) * ahead, middle + (along.max() + margin_m) * ahead
        tracks.append(ends[::-1] if len(tracks) % 2 else ends)
    return tracks


def _ground_below(ground: Ground, start: Floats, stop: Floats, swath_m: float) -> Floats:
    """Return the ground heights below a line and its swath, with shape (along, across)."""
    length_m = float(np.hypot(*(stop - start)))
    ahead = (stop - start) / length_m
    count = int(np.clip(length_m / max(swath_m / 40, 0.5), 2, _ALONG))
    along = np.linspace(0, length_m, count)
    across = np.linspace(-swath_m / 2, swath_m / 2, _ACROSS)
    left = np.array([-ahead[1], ahead[0]])
    points = start + along[:, None, None] * ahead + across[None, :, None] * left
    return ground.heights(points.reshape(-1, 2)).reshape(count, _ACROSS)


def _altitudes(heights: Floats, agl_m: float, length_m: float, follow: bool) -> Floats:
    """Return the heights of the aircraft along a line, with shape (along,).

    With `follow`, the ground below the swath is averaged over a distance of `agl_m`.
    """
    known = np.where(np.isnan(heights).all(axis=1)[:, None], np.nanmean(heights), heights)
    below = np.nanmean(known, axis=1)
    if not follow:
        return np.full(len(below), below.mean() + agl_m)
    samples = min(int(agl_m / (length_m / len(below))) | 1, 2 * len(below) - 1)
    padded = np.pad(below, samples // 2, "edge")
    return np.asarray(np.convolve(padded, np.ones(samples) / samples, "valid") + agl_m)


def _speed(
    scanner: Scanner, swath_m: float, density_m2: float | None, speeds_m_s: tuple[float, float]
) -> tuple[float, float]:
    """Return the speed in m/s and the number of pulses per second for a density."""
    slowest, fastest = speeds_m_s
    if density_m2 is None:
        return fastest, scanner.pulses_hz
    speed_m_s = scanner.pulses_hz / (density_m2 * swath_m)
    if speed_m_s <= fastest:
        return max(math.floor(speed_m_s * 10) / 10, slowest), scanner.pulses_hz
    if not scanner.has_pulse_count:
        return fastest, scanner.pulses_hz
    return fastest, density_m2 * fastest * swath_m


def _rate(scanner: Scanner, swath_m: float, speed_m_s: float, pulses_hz: float) -> float:
    """Return the scan rate at which points have equal distances along and across the track."""
    slowest, fastest = scanner.rates_hz
    lines_hz = math.sqrt(speed_m_s * pulses_hz / swath_m)
    rate_hz = min(max(lines_hz / scanner.lines_per_cycle, slowest), fastest)
    return rate_hz if slowest == fastest else min(max(round(rate_hz, 1), slowest), fastest)


def _shortfalls(plan: FlightPlan, clearances_m: Floats) -> list[str]:
    """Return notes about requirements that the plan does not meet, and how to meet them."""
    scanner = plan.scanner
    sensor = scanner.sensor
    notes = []
    low_density = plan.densities_m2[0]
    if plan.density_m2 is not None and low_density < 0.98 * plan.density_m2:
        share = low_density / plan.density_m2
        half_fov = math.degrees(math.atan(scanner.tangent * share))
        notes.append(
            f"The density of {plan.density_m2:g} points per m² is not reached. At the maximum pulse "
            f"rate of {scanner.pulses_hz / 1000:,.4g} kHz within the swath and the minimum speed of "
            f"{plan.speed_m_s:g} m/s, a strip has {low_density:.3g} points per m². Reduce `--speed` "
            f"to {_floor(plan.speed_m_s * share)}, `--agl` to {_floor(plan.agl_m * share)} or `--fov` "
            f"to {_floor(2 * half_fov)}, or use a sensor with a higher pulse rate"
        )
    high_m = float(clearances_m.max())
    slant_m = high_m / math.cos(math.radians(scanner.half_fov_deg))
    if slant_m > sensor.max_range_m:
        share = sensor.max_range_m / slant_m
        notes.append(
            f"The range at the edges of the swath is up to {slant_m:,.0f} m, but the maximum range "
            f"of {sensor.model} is {sensor.max_range_m:g} m. Reduce `--agl` to "
            f"{_floor(plan.agl_m * share)} or less"
        )
    low_m = float(clearances_m.min())
    if low_m < sensor.min_range_m:
        notes.append(
            f"The aircraft is only {low_m:,.0f} m above the highest ground, but the minimum range of "
            f"{sensor.model} is {sensor.min_range_m:g} m. Increase `--agl` to "
            f"{math.ceil(plan.agl_m + sensor.min_range_m - low_m)}"
        )
    if plan.min_overlap is not None and plan.min_overlap < plan.overlap - 0.02:
        notes.append(
            f"Over the highest ground, the overlap is {plan.min_overlap:.0%} instead of "
            f"{plan.overlap:.0%}. Increase `--overlap`, or follow the terrain with `--follow`"
        )
    ratio = plan.along_m / plan.across_m
    if not 0.5 <= ratio <= 2 and scanner.rates_hz[0] < scanner.rates_hz[1]:
        limit = "maximum" if ratio > 1 else "minimum"
        notes.append(
            f"Points are {plan.along_m:.2f} m apart along the track and {plan.across_m:.2f} m "
            f"across, because the {limit} scan frequency is {plan.rate_hz:g} Hz. "
            + ("Reduce `--speed`" if ratio > 1 else "Increase `--speed` or reduce `--agl`")
        )
    if plan.missing > 0.01:
        notes.append(
            f"The terrain is missing below {plan.missing:.0%} of the "
            f"{plural(len(plan.lines), 'strip')}. Use a terrain that extends beyond the area by half "
            "a swath"
        )
    return notes


def _floor(value: float) -> str:
    """Format a number with two significant digits, rounded down."""
    power = 10.0 ** (math.floor(math.log10(value)) - 1)
    return f"{math.floor(value / power + 1e-9) * power:.6g}"
