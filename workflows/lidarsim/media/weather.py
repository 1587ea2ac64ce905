"""Weather, which attenuates pulses and returns light from the air.

Fog and dust are modeled as continuous media with an extinction and a backscatter coefficient.
Raindrops and snowflakes are modeled individually, with their sizes and positions in the beam. Only
single scattering is considered.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np

from ..numerics.arrays import Floats
from ..numerics.elementary import exp, geomspace, power
from ..numerics.elementary_scalars import exp_of
from ..numerics.vectors import hypot
from ..schema.checks import check_fields
from ..schema.declared import FileSection, UnitShare, about
from ..schema.value_texts import one_line
from .materials import REFERENCE_M, WATER_INDEX, extinction

RAIN_LARGEST_MM = 6.0  # larger drops break up (Pruppacher and Klett 1997)
SNOW_DENSITY = 0.1  # density of dry snow relative to water (Hahner et al. 2022: 0.01 to 0.2)
SNOW_LARGEST_MM = 20.0  # Hahner et al. 2022
SNOW_LIDAR_RATIO_SR = 25.0  # lidar ratio of ice clouds (Young and Vaughan 2009)
DUST_M2_G = 0.6  # mass extinction of mineral dust (Ansmann et al. 2019: 0.57 to 0.63)
DUST_LIDAR_RATIO_SR = 60.0  # Haarig et al. 2022: 46 to 50 at 532 nm, 57 to 69 at 1064 nm
# Ratio of the extinction α = ln 20 / MOR to the backscatter β = 0.046 / MOR, where MOR is the
# visibility (Rasshofer et al. 2011; Hahner et al. 2021). Fog of clean droplets returns more light.
FOG_LIDAR_RATIO_SR = 65.0
DROPS_LIDAR_RATIO_SR = 18.8  # lidar ratio of clean droplets (O'Connor et al. 2004)
SPRAY_DROP_MM = 0.2  # diameter of the drops in spray
CLUMP_MM = 20.0  # mean diameter of the clumps of drops in spray
CLUMP_LARGEST_MM = 100.0  # maximum diameter of a clump
EXIT_M = 0.01  # default beam diameter at the sensor; typical values are 5 to 13 mm
NODES = 4096  # number of ranges in tables and integrals
# Particles that return less than this fraction of the detection threshold are not simulated. Of the
# particles that return half of the threshold, 0.6 % are detected. The simulation therefore misses
# 2 % of the returns from rain and 0.3 % of the returns from snow.
FAINTEST = 0.5
# Particles are simulated between these ranges.
NEAREST_M = 0.1
FARTHEST_M = 1e4
MIN_TRANSMISSION = 1e-200  # avoids division by zero energy
# Ratio of a large particle's extinction to its cross section, half of which is due to diffraction.
LARGE = 2.0


@dataclass(frozen=True, kw_only=True)
class Weather(FileSection):
    """Weather conditions, which attenuate light and return light from the air.

    Rain, snow and dust require `Noise.detection_range_m`, which determines the returns that a
    sensor detects. Without a detection range, fog attenuates light but does not return any.
    """

    visibility_km: Annotated[
        float | None,
        about(
            "meteorological optical range in kilometers, the distance over which fog or haze "
            "attenuates light to 5 % (default: no fog)",
            10.0,
            ge=0.001,
            le=1e6,
        ),
    ] = None
    fog_lidar_ratio_sr: Annotated[
        float | None,
        about(
            "lidar ratio of fog and haze in sr, which is extinction divided by backscatter; 18.8 "
            "for clean droplets, null for no returns from fog",
            18.8,
            ge=1,
            le=1000,
        ),
    ] = FOG_LIDAR_RATIO_SR
    rain_mm_h: Annotated[
        float, about("rain rate in mm/h; drops attenuate and return light", ge=0, le=300)
    ] = 0.0
    snow_mm_h: Annotated[
        float,
        about(
            "snowfall rate in mm/h of melted water; dry flakes attenuate and return light",
            ge=0,
            le=50,
        ),
    ] = 0.0
    dust_mg_m3: Annotated[
        float,
        about(
            "concentration of mineral dust in mg/m³; dust attenuates and returns light",
            ge=0,
            le=1e5,
        ),
    ] = 0.0

    wet: Annotated[
        UnitShare,
        about(
            "fraction of upward-facing surfaces, such as roads, that is covered by a film of water"
        ),
    ] = 0.0

    spray_g_m3: Annotated[
        float,
        about(
            "mass of water in the spray behind a vehicle at 90 km/h on completely wet ground, in "
            "g/m³, such as 1 for a car and 20 for a truck; requires moving vehicles and wet ground",
            5.0,
            ge=0,
            le=1000,
        ),
    ] = 0.0

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def attenuates(self) -> bool:
        """Whether there is rain, snow, dust or fog."""
        return self.visibility_km is not None or bool(
            self.rain_mm_h or self.snow_mm_h or self.dust_mg_m3
        )

    @property
    def returns_light(self) -> bool:
        """Whether rain, snow, dust or fog may return light."""
        return bool(self.rain_mm_h or self.snow_mm_h or self.dust_mg_m3) or self.fog_returns_light

    @property
    def fog_returns_light(self) -> bool:
        """Whether fog may return light, given a sensor with a detection range."""
        return self.visibility_km is not None and self.fog_lidar_ratio_sr is not None

    @property
    def particles(self) -> tuple[Particles, ...]:
        """Kinds of particles in the air: raindrops, snowflakes, both or none."""
        kinds = []
        if self.rain_mm_h:
            kinds.append(raindrops(self.rain_mm_h))
        if self.snow_mm_h:
            kinds.append(snowflakes(self.snow_mm_h))
        return tuple(kinds)

    def extinction_at(self, wavelength_nm: float) -> float:
        """Return the extinction coefficient of the air at the given wavelength, in 1/m."""
        alpha = extinction(self.visibility_km, wavelength_nm)
        for kind in self.particles:
            alpha += kind.extinction
        if self.dust_mg_m3:
            alpha += dust_coefficients(self.dust_mg_m3)[0]
        return alpha

    def backscatter_at(self, wavelength_nm: float) -> float:
        """Return the backscatter coefficient of fog and dust at a given wavelength, in 1/(m sr)."""
        beta = dust_coefficients(self.dust_mg_m3)[1]
        if self.fog_lidar_ratio_sr is not None:
            beta += extinction(self.visibility_km, wavelength_nm) / self.fog_lidar_ratio_sr
        return beta


class Particles(NamedTuple):
    """Size distribution and reflectance of raindrops, snowflakes or clumps of spray.

    The number of particles per volume and diameter D is ``number * exp(-slope * D)`` up to the
    largest diameter. A particle returns the same amount of light as a matte disc with the same
    cross section and `reflectance`.
    """

    number: float  # 1/(m³ mm)
    slope: float  # 1/mm
    largest: float  # mm
    reflectance: float

    @property
    def extinction(self) -> float:
        """Extinction coefficient in 1/m, which is proportional to the total cross section."""
        slope = self.slope
        x = self.slope * self.largest
        squares = 2 / (slope * slope * slope) * (1 - exp_of(-x) * (1 + x + x * x / 2))
        return LARGE * math.pi / 4 * self.number * squares * 1e-6

    def number_above(self, diameter_mm: Floats) -> Floats:
        """Return the number of particles per m³ that are larger than each diameter.

        `diameter_mm` and the result have shape (n,).
        """
        tail = exp(-self.slope * np.minimum(diameter_mm, self.largest))
        return np.asarray(self.number / self.slope * (tail - exp_of(-self.slope * self.largest)))


def raindrops(mm_h: float) -> Particles:
    """Return the distribution of raindrops for a rain rate in mm/h (Marshall and Palmer 1948).

    According to geometrical optics, a drop reflects light at its front and, on the axis, at its
    back. With Fresnel's r = ((n-1)/(n+1))², its reflectance is (r + r (1-r)² (n/(2-n))²) / 4.

    Examples
    --------
    >>> f"{1000 * raindrops(10.0).extinction:.2f}"  # 1/km
    '1.56'
    """
    n = WATER_INDEX
    r = (n - 1) / (n + 1) * ((n - 1) / (n + 1))
    behind = (1 - r) * (n / (2 - n))
    reflectance = (r + r * behind * behind) / 4
    return Particles(8000.0, 4.1 * float(power(mm_h, -0.21)), RAIN_LARGEST_MM, reflectance)


def snowflakes(mm_h: float) -> Particles:
    """Return the distribution of dry snowflakes for a snowfall rate (Gunn and Marshall 1958).

    The snowfall rate is that of the melted water, in mm/h. The size distribution refers to the
    drops into which the flakes melt. A flake with a relative density of 0.1 is 2.15 times as wide
    as its drop. The reflectance is derived from the lidar ratio of ice.

    Examples
    --------
    >>> f"{1000 * snowflakes(1.0).extinction:.2f}"  # 1/km
    '3.34'
    """
    widening = float(power(SNOW_DENSITY, -1 / 3))
    number = 3800.0 * float(power(mm_h, -0.87))
    slope = 2.55 * float(power(mm_h, -0.48))
    reflectance = LARGE * math.pi / SNOW_LIDAR_RATIO_SR
    return Particles(number / widening, slope / widening, SNOW_LARGEST_MM, reflectance)


def spray_clumps(g_m3: float) -> Particles:
    """Return the distribution of clumps of drops in the spray behind a vehicle.

    `g_m3` is the mass of water in the air in g/m³. The extinction of the drops is twice their cross
    section. The drops form clumps, which are assumed to be opaque. The backscatter from an opaque
    cloud of drops is half of the inverse lidar ratio.
    """
    alpha = LARGE * 1.5e-3 * g_m3 / SPRAY_DROP_MM
    unit_cloud = Particles(
        1.0, 1 / CLUMP_MM, CLUMP_LARGEST_MM, math.pi / (2 * DROPS_LIDAR_RATIO_SR)
    )
    return unit_cloud._replace(number=alpha * LARGE / unit_cloud.extinction)


def dust_coefficients(mg_m3: float) -> tuple[float, float]:
    """Return the extinction in 1/m and the backscatter in 1/(m sr) of mineral dust.

    Examples
    --------
    >>> alpha, beta = dust_coefficients(100.0)
    >>> f"{alpha:.3f} {beta:.4f}"
    '0.060 0.0010'
    """
    alpha = DUST_M2_G * mg_m3 / 1000
    return alpha, alpha / DUST_LIDAR_RATIO_SR


def particle_range(min_range_m: float, max_range_m: float) -> tuple[float, float]:
    """Limit a sensor's range interval to the ranges at which particles are simulated."""
    return max(min_range_m, NEAREST_M), min(max_range_m, FARTHEST_M)


class Air(NamedTuple):
    """Properties of the air and of a sensor's beam that determine the energy of returns.

    Energies are relative to the energy from a white surface at a distance of 10 m. The beam is
    round and uniformly bright.

    At a range R below `overlap_m`, the receiver sees the fraction (R / overlap_m)² of the beam, as
    for a receiver that is focused at a long range. The received energy is constant at these ranges
    (Harms, Lahmann and Weitkamp 1978).

    Attributes
    ----------
    extinction
        Extinction coefficient in 1/m.
    exit_m
        Diameter of the beam in meters where it leaves the sensor.
    divergence
        Full divergence angle in radians.
    overlap_m
        Minimum range in meters at which the receiver sees the entire beam.
    """

    extinction: float
    exit_m: float
    divergence: float
    overlap_m: float

    def beam_diameter(self, distance: Floats) -> Floats:
        """Return the diameter of the beam at each distance, in meters.

        `distance` and the result have shape (n,).
        """
        return np.asarray(hypot(self.exit_m, self.divergence * distance))

    def white_energy(self, distance: Any) -> Any:
        """Return the energy from a white disc that fills the beam at a given distance in meters."""
        effective_m = np.maximum(distance, max(self.overlap_m, 1e-3))
        transmission = exp(-2 * self.extinction * distance)
        return np.square(REFERENCE_M / effective_m) * np.maximum(transmission, MIN_TRANSMISSION)

    def min_diameter_mm(self, particles: Particles, energy: float, distance: Floats) -> Floats:
        """Return the minimum diameter of a particle that returns the given energy, in millimeters.

        `distance` is in meters, and has shape (n,) like the result. The diameter is infinite at
        distances at which no particle returns the energy.
        """
        fraction = energy / (particles.reflectance * self.white_energy(distance))
        diameter_mm = 1000 * self.beam_diameter(distance) * np.sqrt(fraction)
        return np.where(fraction <= 1, diameter_mm, np.inf)

    def particle_rate(self, particles: Particles, energy: float, distance: Floats) -> Floats:
        """Return the number of particles per meter of beam that return at least the given energy.

        `distance` is in meters, and has shape (n,) like the result.
        """
        area = math.pi / 4 * np.square(self.beam_diameter(distance))
        return area * particles.number_above(self.min_diameter_mm(particles, energy, distance))

    def mean_particles(
        self, particles: Particles, energy: float, start_m: float, stop_m: float
    ) -> float:
        """Return the mean number of particles in a beam that return at least the given energy.

        Only particles between the ranges `start_m` and `stop_m` are counted.
        """
        distance = geomspace(start_m, max(stop_m, start_m * 1.001), NODES)
        return float(np.trapezoid(self.particle_rate(particles, energy, distance), distance))

    def backscatter_energy(self, backscatter: float, starts: Floats, stops: Floats) -> Floats:
        """Return the energies that fog or dust returns from slabs across the beam.

        `starts` and `stops` are ranges in meters, and have shape (n,) like the result. The energies
        are integrated with Simpson's rule.
        """
        middle = (starts + stops) / 2
        slab = stops - starts
        mean = (
            self.white_energy(starts) + 4 * self.white_energy(middle) + self.white_energy(stops)
        ) / 6
        return np.asarray(math.pi * backscatter * slab * mean)
