"""Plan flight lines of an airborne survey, and the speed and rates that a density requires.

The swath of a line is 2 h tan(FOV / 2) for a height h above ground, and the density of a strip is
the pulse rate divided by the speed and the swath (Baltsavias 1999).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.schema.checks import check_number
from lidarsim.survey.survey import MAX_SENSORS
from lidarsim.words import plural

from .flight_lines import FlightLine, Kind, Layout, Terrain, longest_side, place_lines
from .flight_path import FlightPath, fly
from .flight_scanner import AirborneScanner

SPEEDS_M_S = (3.0, 70.0)  # default limits of the speed over ground
_QUANTILES = (0.05, 0.95)  # of the height above ground, for the spacing and for the speed
_CLOSE = 0.1  # a note is shown if lines are closer than this share of the swath
_EVEN = 2.0  # maximum ratio of the distances along and across the track without a note


class Rates(NamedTuple):
    """Speed of the aircraft and rates of the scanner."""

    speed_m_s: float
    scan_hz: float  # cycles per second
    lines_hz: float  # scan lines per second
    pulses_hz: float  # pulses per second within the planned field of view
    fired_hz: float  # pulses per second
    pulses_per_cycle: int | None  # number of firings per cycle, or None if it is fixed

    def density_m2(self, swath_m: float) -> float:
        """Return the number of pulses per square meter in a strip."""
        return self.pulses_hz / (self.speed_m_s * swath_m)


@dataclass(frozen=True, eq=False)
class FlightPlan:
    """Flight lines with the speed and the rates of the scanner.

    Heights and positions are in world coordinates, in meters.
    """

    area: Any  # Shapely polygon
    scanner: AirborneScanner
    lines: tuple[FlightLine, ...]
    path: FlightPath
    rates: Rates
    layout: Layout
    spacing_m: float | None  # distance between adjacent lines, or None for a single line
    lowest_m: float  # minimum height above ground below all strips
    highest_m: float  # maximum height above ground below all strips
    density_m2: float | None  # requested density
    densities_m2: tuple[float, float]  # densities of a strip over the lowest and highest ground
    missing: float  # share of the samples without ground
    has_holes: bool  # whether there are samples without ground in the area
    reach_m: float  # distance by which the strips extend beyond the area
    # Height above ground at which no ground is closer than the minimum range, or None if the
    # planned height is sufficient
    required_agl_m: int | None = None
    notes: tuple[str, ...] = ()  # requirements that are not met, and how to meet them

    @property
    def swath_m(self) -> float:
        """Width of the swath at the requested height above ground, in meters."""
        return self.scanner.swath_m(self.layout.agl_m)

    def count(self, kind: Kind) -> int:
        """Return the number of flight lines or cross strips."""
        return sum(line.kind == kind for line in self.lines)

    @property
    def counts(self) -> str:
        """Text with the numbers of flight lines and cross strips."""
        lines = plural(self.count("line"), "flight line")
        cross = self.count("cross")
        return f"{lines} and {plural(cross, 'cross strip')}" if cross else lines

    @property
    def farthest_m(self) -> float:
        """Maximum distance between the scanner and the ground, at the edges of the swath."""
        return self.highest_m / math.cos(math.radians(self.scanner.half_fov_deg))

    @property
    def is_in_range(self) -> bool:
        """Whether all the ground below the strips is within the range limits of the sensor."""
        return self.required_agl_m is None and self.farthest_m <= self.scanner.sensor.max_range_m

    def line_density_m2(self, line: FlightLine) -> tuple[float, float]:
        """Return the densities of a strip over the lowest and the highest ground below it."""
        narrow_m, wide_m = line.swath_m
        return self.rates.density_m2(wide_m), self.rates.density_m2(narrow_m)

    @property
    def min_overlap(self) -> float | None:
        """Overlap of adjacent strips over the highest ground, or None for a single line."""
        if self.spacing_m is None:
            return None
        return 1 - self.spacing_m / self.scanner.swath_m(self.lowest_m)

    @property
    def along_m(self) -> float:
        """Mean distance between scan lines in meters."""
        return self.rates.speed_m_s / self.rates.lines_hz

    @property
    def across_m(self) -> float:
        """Mean distance between the pulses of a scan line in meters."""
        return self.swath_m * self.rates.lines_hz / self.rates.pulses_hz

    @property
    def duration_s(self) -> float:
        """Time in the air in seconds, including turns."""
        return float(self.path.times_s[-1])

    @property
    def length_m(self) -> float:
        """Total length of the flight lines in meters."""
        return sum(line.leg.length_m for line in self.lines)


def plan_flight(
    area: Any,
    terrain: Terrain,
    scanner: AirborneScanner,
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

    The lines are parallel to the longest side of the area. Adjacent strips have at least the
    requested overlap, with a tolerance of 1 % of the swath, at the 5 % quantile of the heights
    above ground. Strips have the requested density at the 95 % quantile.

    Parameters
    ----------
    area
        Shapely polygon or multipolygon in world coordinates, in meters.
    terrain
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
        the aircraft, if no ground is within the range limits of the sensor, or if there are too
        many lines.

    Examples
    --------
    >>> import shapely
    >>> scanner = AirborneScanner.load("airborne/riegl-vq780i")
    >>> plan = plan_flight(shapely.box(0, 0, 2000, 900), Terrain(), scanner, agl_m=700)
    >>> len(plan.lines), round(plan.scanner.swath_m(700))
    (2, 808)
    """
    check_number("agl_m", agl_m, gt=0, le=20_000)
    check_number("overlap", overlap, ge=0, le=0.95)
    check_number("cross", cross, whole=True, ge=0, le=MAX_SENSORS)
    if density_m2 is not None:
        check_number("density_m2", density_m2, gt=0, le=1e5)
    heading = longest_side(area) if heading_deg is None else math.radians(90 - heading_deg)
    layout = Layout(agl_m, heading, overlap, cross, follow)
    strips = place_lines(area, terrain, scanner, layout, _QUANTILES[0])
    lowest_m = float(strips.clearances_m.min())
    highest_m = float(strips.clearances_m.max())
    required_agl_m = None
    if lowest_m < max(scanner.sensor.min_range_m, 1e-3):
        required_agl_m = _required_agl_m(area, terrain, scanner, layout, lowest_m)
    _check_heights(scanner, lowest_m, highest_m, required_agl_m)
    quantiles_m = np.quantile(strips.clearances_m, _QUANTILES).tolist()
    narrow_m, wide_m = map(scanner.swath_m, quantiles_m)
    rates = _choose_rates(scanner, wide_m, scanner.swath_m(agl_m), density_m2, speeds_m_s)
    plan = FlightPlan(
        area=area,
        scanner=scanner,
        lines=tuple(strips.lines),
        path=fly([line.leg for line in strips.lines], rates.speed_m_s),
        rates=rates,
        layout=layout,
        spacing_m=strips.spacing_m,
        lowest_m=lowest_m,
        highest_m=highest_m,
        density_m2=density_m2,
        densities_m2=(rates.density_m2(wide_m), rates.density_m2(narrow_m)),
        missing=strips.missing,
        has_holes=strips.has_holes,
        reach_m=strips.reach_m,
        required_agl_m=required_agl_m,
    )
    return replace(plan, notes=tuple(_shortfalls(plan)))


def _required_agl_m(
    area: Any, terrain: Terrain, scanner: AirborneScanner, layout: Layout, lowest_m: float
) -> int:
    """Return a height above ground in meters at which no ground is closer than the minimum range.

    `lowest_m` is the minimum distance from the ground at the current height. The strips of higher
    lines are wider, so they may contain higher ground.
    """
    least_m = max(scanner.sensor.min_range_m, 1.0)
    agl_m = layout.agl_m
    while lowest_m < least_m:
        agl_m = float(math.ceil(agl_m + least_m - lowest_m))
        strips = place_lines(area, terrain, scanner, replace(layout, agl_m=agl_m), _QUANTILES[0])
        lowest_m = float(strips.clearances_m.min())
    return round(agl_m)


def _check_heights(
    scanner: AirborneScanner, lowest_m: float, highest_m: float, required_agl_m: int | None
) -> None:
    """Raise LidarError if the ground is above the aircraft, or if no point is in range."""
    if not lowest_m > 0:
        raise LidarError(
            f"The ground rises {-lowest_m:.0f} m above a flight line. Increase `--agl` to "
            f"{required_agl_m}, or follow the terrain with `--follow`."
        )
    sensor = scanner.sensor
    farthest_m = highest_m / math.cos(math.radians(scanner.half_fov_deg))
    if farthest_m < sensor.min_range_m:
        raise LidarError(
            f"No point is within the range limits of {sensor.model}. Its minimum range is "
            f"{sensor.min_range_m:g} m, but the ground is at most {farthest_m:.0f} m from the "
            f"scanner at the height of the flight lines. Increase `--agl` to {required_agl_m}, or "
            "use another sensor."
        )
    if lowest_m > sensor.max_range_m:
        raise LidarError(
            f"No point is within the range limits of {sensor.model}. Its maximum range is "
            f"{sensor.max_range_m:g} m, but the flight lines are at least {lowest_m:.0f} m above "
            "the ground. Reduce `--agl`, or use another sensor."
        )


def _choose_rates(
    scanner: AirborneScanner,
    wide_m: float,
    swath_m: float,
    density_m2: float | None,
    speeds_m_s: tuple[float, float],
) -> Rates:
    """Choose the speed and the rates for a density.

    Parameters
    ----------
    scanner
        The scanner with the limits of its rates.
    wide_m
        Swath in meters at which the density is required.
    swath_m
        Swath in meters at which points have equal distances along and across the track.
    density_m2
        Number of points per square meter, or None for the maximum pulse rate and speed.
    speeds_m_s
        Minimum and maximum speed in m/s.
    """
    slowest, fastest = speeds_m_s
    speed_m_s, pulses_hz = fastest, scanner.pulses_hz
    if density_m2 is not None:
        ideal_m_s = scanner.pulses_hz / (density_m2 * wide_m)
        if ideal_m_s < fastest:
            speed_m_s = max(math.floor(ideal_m_s * 10) / 10, slowest)
        elif scanner.has_pulse_count:
            pulses_hz = density_m2 * fastest * wide_m
    scan_hz = _scan_rate(scanner, math.sqrt(speed_m_s * pulses_hz / swath_m))
    fired_hz = scanner.fired_hz * pulses_hz / scanner.pulses_hz
    count = None
    if scanner.has_pulse_count:
        # The number of firings is rounded up, unless the pulse rate would exceed its maximum.
        per_cycle = fired_hz / scan_hz / scanner.sensor.channels
        count = max(math.floor(per_cycle) + (fired_hz < scanner.fired_hz * 0.999), 1)
        fired_hz = count * scan_hz * scanner.sensor.channels
        pulses_hz = scanner.pulses_hz * fired_hz / scanner.fired_hz
    lines_hz = scan_hz * scanner.lines_per_cycle
    return Rates(speed_m_s, scan_hz, lines_hz, pulses_hz, fired_hz, count)


def _scan_rate(scanner: AirborneScanner, lines_hz: float) -> float:
    """Return the number of cycles per second for a number of scan lines, within the limits."""
    slowest, fastest = scanner.rates_hz
    rate_hz = round(lines_hz / scanner.lines_per_cycle, 1)
    return slowest if slowest == fastest else min(max(rate_hz, slowest), fastest)


def _shortfalls(plan: FlightPlan) -> Iterator[str]:
    """Yield notes about requirements that the plan does not meet, and how to meet them."""
    yield from _density_shortfall(plan)
    yield from _range_shortfalls(plan)
    spacing_m = plan.spacing_m
    if plan.count("line") == 2 and spacing_m is not None and spacing_m < _CLOSE * plan.swath_m:
        higher_m = spacing_m / (2 * plan.scanner.tangent)
        yield (
            f"The two lines are only {spacing_m:.1f} m apart. A single line covers the area with "
            f"`--agl {math.ceil(plan.layout.agl_m + higher_m)}`"
        )
    overlap = plan.min_overlap
    if overlap is not None and overlap < plan.layout.overlap - 0.02:
        remedy = "" if plan.layout.follow else ", or follow the terrain with `--follow`"
        yield (
            f"Over the highest ground, the overlap is {round(overlap, 2) + 0.0:.0%} instead of "
            f"{plan.layout.overlap:.0%}. Increase `--overlap`{remedy}"
        )
    ratio = plan.along_m / plan.across_m
    slowest, fastest = plan.scanner.rates_hz
    if not 1 / _EVEN <= ratio <= _EVEN and slowest < fastest:
        # The distance along the track is proportional to the speed.
        limit, remedy = "maximum", f"Reduce `--speed` to {_floor(plan.rates.speed_m_s / ratio)}"
        if ratio < 1:
            limit, remedy = "minimum", "Increase `--speed`, or reduce `--agl`"
        yield (
            f"Points are {plan.along_m:.2f} m apart along the track and {plan.across_m:.2f} m "
            f"across, because the {limit} scan frequency is {plan.rates.scan_hz:g} Hz. {remedy}"
        )
    if plan.has_holes:
        yield (
            "The terrain is missing below a part of the area. Use a terrain that covers the area "
            "without holes"
        )
    elif plan.missing > 0.01:
        yield (
            f"The terrain is missing below {plan.missing:.0%} of the "
            f"{plural(len(plan.lines), 'strip')}. Use a terrain that extends beyond the area by "
            f"{math.ceil(plan.reach_m)} m"
        )


def _density_shortfall(plan: FlightPlan) -> Iterator[str]:
    """Yield a note if a strip has fewer points than requested."""
    found = plan.densities_m2[0]
    if plan.density_m2 is None or found >= 0.98 * plan.density_m2:
        return
    share = found / plan.density_m2
    speed_m_s = plan.rates.speed_m_s
    yield (
        f"The density of {plan.density_m2:g} points per m² is not reached. At the maximum rate of "
        f"{plan.scanner.pulses_hz / 1000:,.4g} kHz within the swath and a speed of {speed_m_s:g} "
        f"m/s, a strip has {found:.3g} points per m². Reduce `--speed` to "
        f"{_floor(speed_m_s * share)} or `--agl` to {_floor(plan.layout.agl_m * share)}, or use a "
        "sensor with a higher pulse rate"
    )


def _range_shortfalls(plan: FlightPlan) -> Iterator[str]:
    """Yield notes if the ground is out of range."""
    sensor = plan.scanner.sensor
    agl_m = plan.layout.agl_m
    slant_m = plan.farthest_m
    if slant_m > sensor.max_range_m:
        yield (
            f"The range at the edges of the swath is up to {slant_m:,.0f} m, but the maximum range "
            f"of {sensor.model} is {sensor.max_range_m:g} m. Reduce `--agl` to "
            f"{_floor(agl_m * sensor.max_range_m / slant_m)} or less, or reduce `--fov`"
        )
    if plan.required_agl_m is not None:
        yield (
            f"The aircraft is only {math.floor(10 * plan.lowest_m) / 10:,g} m above the highest "
            f"ground, but the minimum range of {sensor.model} is {sensor.min_range_m:g} m. "
            f"Increase `--agl` to {plan.required_agl_m}"
        )


def _floor(value: float) -> str:
    """Format a number with two significant digits, rounded down."""
    power = 10.0 ** (math.floor(math.log10(value)) - 1)
    return f"{math.floor(value / power + 1e-9) * power:.6g}"
