"""Weather: extinction of a pulse's light in the air, and back-scatter from it.

Fog and dust are too fine to be seen one by one: they have an extinction and a back-scatter. Drops
of rain and flakes of snow are seen one by one, by their size and position in the beam. Light is
scattered once.
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
SNOW_DENSITY = 0.1  # relative to water: dry snow, between 0.01 and 0.2 (Hahner et al. 2022)
SNOW_LARGEST_MM = 20.0  # Hahner et al. 2022
SNOW_LIDAR_RATIO_SR = 25.0  # value of ice clouds (Young and Vaughan 2009)
DUST_M2_G = 0.6  # mass extinction of mineral dust (Ansmann et al. 2019: 0.57 to 0.63)
DUST_LIDAR_RATIO_SR = 60.0  # Haarig et al. 2022: 46 to 50 at 532 nm, 57 to 69 at 1064 nm
# β = 0.046 / MOR (Rasshofer et al. 2011; Hahner et al. 2021), and α = ln 20 / MOR. Fog of clean
# droplets returns more: DROPS_LIDAR_RATIO_SR.
FOG_LIDAR_RATIO_SR = 65.0
DROPS_LIDAR_RATIO_SR = 18.8  # value of clean droplets (O'Connor et al. 2004)
# diameters; of clumps, the mean
SPRAY_DROP_MM = 0.2
CLUMP_MM = 20.0
CLUMP_LARGEST_MM = 100.0
EXIT_M = 0.01  # the beam's diameter at the sensor, if it is unknown: 5 to 13 mm
NODES = 4096  # ranges at which tables and integrals are made
# Share of the detection threshold below which particles are left out: 0.6 % of the particles that
# return half of the threshold are detected. Leaving the fainter particles out misses 2 % of the
# returns from rain, and 0.3 % of the returns from snow.
FAINTEST = 0.5
# ranges between which particles are simulated
NEAREST_M = 0.1
FARTHEST_M = 1e4
MIN_TRANSMISSION = 1e-200  # limit for the light, so that divisions by an energy are finite
LARGE = 2.0  # extinction of a large particle, in its cross-sections: half of it by diffraction


@dataclass(frozen=True, kw_only=True)
class Weather(FileSection):
    """Extinction of the air, and returns from the air.

    Rain, snow and dust need `Noise.detection_range_m`, which decides what a sensor detects. Fog
    attenuates light without it, too, but returns none then.
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
    def returns_light(self) -> bool:
        """Whether rain, snow, dust or fog may return light."""
        return bool(self.rain_mm_h or self.snow_mm_h or self.dust_mg_m3) or self.fog_returns_light

    @property
    def fog_returns_light(self) -> bool:
        """Whether fog may return light, to sensors with a detection range."""
        return self.visibility_km is not None and self.fog_lidar_ratio_sr is not None

    @property
    def particles(self) -> tuple[Particles, ...]:
        """Kinds of particles in the air: drops and flakes."""
        kinds = []
        if self.rain_mm_h:
            kinds.append(rain(self.rain_mm_h))
        if self.snow_mm_h:
            kinds.append(snow(self.snow_mm_h))
        return tuple(kinds)

    def extinction_at(self, wavelength_nm: float) -> float:
        """Return the extinction of the air at a wavelength, 1/m."""
        alpha = extinction(self.visibility_km, wavelength_nm)
        for kind in self.particles:
            alpha += kind.extinction
        if self.dust_mg_m3:
            alpha += dust(self.dust_mg_m3)[0]
        return alpha

    def backscatter_at(self, wavelength_nm: float) -> float:
        """Return the backscatter of fog and dust at a wavelength, 1/(m sr)."""
        beta = dust(self.dust_mg_m3)[1]
        if self.fog_lidar_ratio_sr is not None:
            beta += extinction(self.visibility_km, wavelength_nm) / self.fog_lidar_ratio_sr
        return beta


class Particles(NamedTuple):
    """Drops or flakes, ``number * exp(-slope * D)`` by diameter D, up to the largest diameter.

    A particle returns as much light as a matt disc of its cross-section and `reflectance`.
    """

    number: float  # 1/(m³ mm)
    slope: float  # 1/mm
    largest: float  # mm
    reflectance: float

    @property
    def extinction(self) -> float:
        """Extinction, 1/m, in proportion to the cross-sections of the particles."""
        slope = self.slope
        x = self.slope * self.largest
        squares = 2 / (slope * slope * slope) * (1 - exp_of(-x) * (1 + x + x * x / 2))
        return LARGE * math.pi / 4 * self.number * squares * 1e-6

    def above(self, diameter_mm: Floats) -> Floats:
        """Return the density of particles above diameters (n,), 1/m³: (n,)."""
        tail = exp(-self.slope * np.minimum(diameter_mm, self.largest))
        return np.asarray(self.number / self.slope * (tail - exp_of(-self.slope * self.largest)))


def rain(mm_h: float) -> Particles:
    """Return the drops of a rain of `mm_h` millimeters an hour (Marshall and Palmer 1948).

    A drop mirrors light at its front and, on the axis, at its back, by geometrical optics: with
    Fresnel's r = ((n-1)/(n+1))², its reflectance is (r + r (1-r)² (n/(2-n))²) / 4.

    Examples
    --------
    >>> f"{1000 * rain(10.0).extinction:.2f}"  # 1/km
    '1.56'
    """
    n = WATER_INDEX
    r = (n - 1) / (n + 1) * ((n - 1) / (n + 1))
    behind = (1 - r) * (n / (2 - n))
    reflectance = (r + r * behind * behind) / 4
    return Particles(8000.0, 4.1 * float(power(mm_h, -0.21)), RAIN_LARGEST_MM, reflectance)


def snow(mm_h: float) -> Particles:
    """Return the flakes of dry snow, by its melted water in mm/h (Gunn and Marshall 1958).

    The flakes are distributed as the drops that they melt to; a flake of density 0.1 is 2.15 times
    as wide as its drop. The reflectance follows from the lidar ratio of ice.

    Examples
    --------
    >>> f"{1000 * snow(1.0).extinction:.2f}"  # 1/km
    '3.34'
    """
    widening = float(power(SNOW_DENSITY, -1 / 3))
    number = 3800.0 * float(power(mm_h, -0.87))
    slope = 2.55 * float(power(mm_h, -0.48))
    reflectance = LARGE * math.pi / SNOW_LIDAR_RATIO_SR
    return Particles(number / widening, slope / widening, SNOW_LARGEST_MM, reflectance)


def spray(g_m3: float) -> Particles:
    """Return the clumps of drops behind a vehicle, by the mass of the water in the air, g/m³.

    The extinction of drops is twice their cross-sections. Drops are in clumps that are assumed to
    be opaque; an opaque cloud of drops returns half of the inverse lidar ratio.
    """
    alpha = LARGE * 1.5e-3 * g_m3 / SPRAY_DROP_MM
    unit_cloud = Particles(
        1.0, 1 / CLUMP_MM, CLUMP_LARGEST_MM, math.pi / (2 * DROPS_LIDAR_RATIO_SR)
    )
    return unit_cloud._replace(number=alpha * LARGE / unit_cloud.extinction)


def dust(mg_m3: float) -> tuple[float, float]:
    """Return the extinction, 1/m, and the back-scatter, 1/(m sr), of mineral dust.

    Examples
    --------
    >>> alpha, beta = dust(100.0)
    >>> f"{alpha:.3f} {beta:.4f}"
    '0.060 0.0010'
    """
    alpha = DUST_M2_G * mg_m3 / 1000
    return alpha, alpha / DUST_LIDAR_RATIO_SR


def reach(min_range_m: float, max_range_m: float) -> tuple[float, float]:
    """Return the shortest and the longest range of particles, meters, for a sensor's ranges."""
    return max(min_range_m, NEAREST_M), min(max_range_m, FARTHEST_M)


class Air(NamedTuple):
    """Air along the beams of a sensor. Energies are relative: 1 for a white surface at 10 m.

    The beam is evenly bright and round. Nearer than `overlap_m` the receiver sees the part
    (R / overlap_m)² of the beam, as a receiver does that is focused at a long range: the received
    energy is constant there (Harms, Lahmann and Weitkamp 1978).
    """

    extinction: float  # 1/m
    exit_m: float  # diameter of the beam where it leaves the sensor, meters
    divergence: float  # full angle, radians
    overlap_m: float  # nearest range where the receiver sees the beam completely

    def width(self, distance: Floats) -> Floats:
        """Return the diameters of the beam at distances (n,), meters: (n,)."""
        return np.asarray(hypot(self.exit_m, self.divergence * distance))

    def white_energy(self, distance: Any) -> Any:
        """Return the energy of a white disc that fills the beam, at distances in meters."""
        effective_m = np.maximum(distance, max(self.overlap_m, 1e-3))
        transmission = exp(-2 * self.extinction * distance)
        return np.square(REFERENCE_M / effective_m) * np.maximum(transmission, MIN_TRANSMISSION)

    def smallest(self, particles: Particles, energy: float, distance: Floats) -> Floats:
        """Return the diameters of particles that return an energy, millimeters: (n,).

        `distance` (n,) is in meters; the diameter is inf where no particle returns the energy.
        """
        share = energy / (particles.reflectance * self.white_energy(distance))
        diameter_mm = 1000 * self.width(distance) * np.sqrt(share)
        return np.where(share <= 1, diameter_mm, np.inf)

    def rate(self, particles: Particles, energy: float, distance: Floats) -> Floats:
        """Return the number of particles in the beam that return at least an energy: (n,), 1/m."""
        area = math.pi / 4 * np.square(self.width(distance))
        return area * particles.above(self.smallest(particles, energy, distance))

    def mean_particles(
        self, particles: Particles, energy: float, start_m: float, stop_m: float
    ) -> float:
        """Return the mean number of particles in a beam that return at least an energy.

        Particles are counted from `start_m` to `stop_m`, ranges in meters.
        """
        distance = geomspace(start_m, max(stop_m, start_m * 1.001), NODES)
        return float(np.trapezoid(self.rate(particles, energy, distance), distance))

    def cloud(self, backscatter: float, starts: Floats, stops: Floats) -> Floats:
        """Return the energies (n,) that fog or dust returns from slabs that fill the beam.

        `starts` and `stops` (n,) are ranges in meters; energies are means by Simpson's rule.
        """
        middle = (starts + stops) / 2
        slab = stops - starts
        mean = (
            self.white_energy(starts) + 4 * self.white_energy(middle) + self.white_energy(stops)
        ) / 6
        return np.asarray(math.pi * backscatter * slab * mean)
