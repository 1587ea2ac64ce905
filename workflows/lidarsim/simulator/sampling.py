"""Estimate properties of a survey by casting a sample of its rays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from raybeam import available_backends

from ..media.weather import Weather
from ..numerics.arrays import Bools, Floats, Ints, Ints32
from ..numerics.even_samples import even_indices
from ..scene.scene import Scene
from ..schema.declared import declared_values
from ..sensor import Noise, Returns, Sensor
from ..sensor.beams import Beams
from ..survey.survey import Mounted, Survey
from .rig import Rig

SAMPLE_RAYS = 500_000  # maximum number of rays that `sample_survey` casts
SAMPLE_SECTIONS = 500  # maximum number of sections of consecutive scans that are sampled
SECTION_SCANS = 40  # maximum number of consecutive scans in a section
RANGE_RAYS = 20_000  # number of rays that `sample_ranges` and `sample_near_surfaces` cast
GOLDEN = 0.6180339887498949  # golden ratio minus 1


def sample_survey(scene: Scene, survey: Survey, backend: str = "auto") -> dict[str, int]:
    """Estimate the numbers of hits and points in a survey by casting a sample of its rays.

    The sampled rays are spread evenly over all scans. In a survey of many thousand scans, they are
    spread over evenly spaced sections instead. In a small survey, all rays are cast. The result has
    the number of cast rays (`rays`), and the estimated numbers of hits (`hits`) and points
    (`points`) in the whole survey.
    """
    firsts, stops = _sampled_scans(survey, range(survey.scan_count))
    subrays = max(returns.subrays for returns in survey.returns_each)
    rays = survey.ray_count * subrays * int((stops - firsts).sum()) // survey.scan_count
    sampled = survey
    if (every := -(-rays // SAMPLE_RAYS)) > 1:
        # Settings that apply to individual channels do not fit a sensor with a single beam.
        without_channels: dict[str, Any] = {"channel_bias_m": 0.0, "ripple_deg": 0.0}
        carried = [
            replace(mounted, noise=mounted.noise and replace(mounted.noise, **without_channels))
            for mounted in _with_few_rays(survey, every)
        ]
        noise = replace(survey.noise, **without_channels)
        sampled = replace(survey, sensors=carried, noise=noise, faults=())
    cast_rays = 0
    sampled_rays = 0  # number of the survey's rays that the cast rays represent
    hit_count = 0
    points = 0
    for batch in _batches(Rig(scene, sampled, backend), firsts, stops):
        every = getattr(sampled.mounted_sensors[batch.specs[0].sensor].sensor, "every", 1)
        rays = sum(spec.ray_count for spec in batch.specs)
        cast_rays = cast_rays + rays
        sampled_rays = sampled_rays + rays * every
        hit_count += int(batch.hit_counts.sum()) * every
        points += int(np.ceil(batch.hit_counts * every / survey.keep_every).sum())
    fraction = survey.ray_count / sampled_rays
    return {
        "rays": cast_rays,
        "hits": round(hit_count * fraction),
        "points": round(points * fraction),
    }


def sample_ranges(scene: Scene, survey: Survey, scans: range | None = None) -> Floats:
    """Return the distances, in meters, at which sampled rays of a survey hit surfaces.

    The sensors are simulated without range limits, noise, faults and weather. Rays that hit no
    surface are omitted. Rays are sampled from `scans`, by default from all scans of the survey.
    """
    firsts, stops = _sampled_scans(survey, range(survey.scan_count) if scans is None else scans)
    rays = survey.ray_count * int((stops - firsts).sum()) // survey.scan_count
    carried = [
        replace(
            mounted,
            sensor=replace(mounted.sensor, min_range_m=0.0, max_range_m=np.inf),
            noise=Noise(),
            returns=Returns(),
        )
        for mounted in _with_few_rays(survey, max(1, -(-rays // RANGE_RAYS)))
    ]
    plain = replace(
        survey,
        sensors=carried,
        noise=Noise(),
        returns=Returns(),
        faults=(),
        navigation=None,
        columns=(),
        waveform_samples=0,
        keep_every=1,
        **declared_values(Weather(), Weather),
    )
    # CUDA is never used, because its context would stay in this process.
    backend = "numpy" if available_backends()["tiles"] else "tiles"
    batches = _batches(Rig(scene, plain, backend), firsts, stops)
    return np.concatenate([np.zeros(0), *(batch.range for batch in batches)])


class NearSurfaces(NamedTuple):
    """Surfaces that rays of a sensor pass, because they are closer than its minimum range."""

    points: float  # fraction of the points that are behind such a surface
    name: str  # object that most of these rays pass
    distance_m: float  # of the closest surface of this object


def sample_near_surfaces(scene: Scene, survey: Survey) -> list[NearSurfaces | None]:
    """Return the surfaces that are closer to each sensor than its minimum range.

    Rays are sampled from the whole survey, without noise and weather. Surfaces through which light
    passes anyway, such as windows and hedges, do not count. The entry of a sensor is None if no
    sampled ray passes a surface and hits another one within the range.
    """
    carried = [
        replace(mounted, sensor=replace(mounted.sensor, min_range_m=0.0), steps=steps)
        for mounted, steps in zip(survey.mounted_sensors, survey.steps_each, strict=True)
    ]
    # CUDA is never used, because its context would stay in this process.
    backend = "numpy" if available_backends()["tiles"] else "tiles"
    rig = Rig(scene, survey, backend)
    unlimited = rig.with_survey(scene, replace(survey, sensors=carried))
    passed: list[list[_PassedSurfaces]] = [[] for _ in carried]
    for scan in _spread_scans(survey):
        passed[survey.scan(scan).sensor] += _passed_surfaces(rig, unlimited, scan)
    return [_near_surfaces(scene, rays) for rays in passed]


class _PassedSurfaces(NamedTuple):
    """Rays that pass an opaque surface and hit another one."""

    points: int  # number of rays that hit a surface, including all others
    objects: Ints32  # (k,), object whose surface a ray passes
    distances: Floats  # (k,), meters


def _spread_scans(survey: Survey) -> list[int]:
    """Return scans of a survey that cover all directions of rotating heads."""
    count = min(survey.scan_count, SAMPLE_SECTIONS)
    count = min(count, max(1, RANGE_RAYS * survey.scan_count // survey.ray_count))
    # If the scans were evenly spaced, they might have the same direction in each revolution.
    shares = (np.arange(count) + np.arange(count) * GOLDEN % 1) / count
    scans: list[int] = np.unique((shares * survey.scan_count).astype(np.int64)).tolist()
    return scans


def _passed_surfaces(rig: Rig, unlimited: Rig, scan: int) -> Iterator[_PassedSurfaces]:
    """Cast the rays of a scan with the minimum range of the sensor and without it."""
    survey = rig.survey
    table = rig.surfaces.materials
    is_opaque = ~(table.passes | (table.gap_fraction > 0) | (table.leaf_area > 0))
    min_range_m = survey.mounted_sensors[survey.scan(scan).sensor].sensor.min_range_m
    groups = (rig.central_rays(scan, scan + 1), unlimited.central_rays(scan, scan + 1))
    for within, first in zip(*groups, strict=True):
        is_point = np.isfinite(within.ranges)
        rows = np.flatnonzero(is_point & (first.ranges < min_range_m))
        triangles = first.triangles[rows]
        chosen = is_opaque[rig.surfaces.triangle_kinds.of_triangles(triangles)]
        objects = rig.surfaces.triangles.objects(triangles)[chosen]
        yield _PassedSurfaces(int(is_point.sum()), objects, first.ranges[rows][chosen])


def _near_surfaces(scene: Scene, passed: list[_PassedSurfaces]) -> NearSurfaces | None:
    """Summarize the surfaces that rays of a sensor pass."""
    objects = np.concatenate([np.zeros(0, np.int32), *(rays.objects for rays in passed)])
    if not len(objects):
        return None
    distances = np.concatenate([rays.distances for rays in passed])
    points = sum(rays.points for rays in passed)
    number = int(np.bincount(objects).argmax())
    nearest_m = float(distances[objects == number].min())
    return NearSurfaces(len(objects) / points, scene.object_names[number], nearest_m)


def _sampled_scans(survey: Survey, scans: range) -> tuple[Ints, Ints]:
    """Return the start and stop of evenly spaced sections of `scans`."""
    # Limit the length so that a section spans at most two stations, which are cast separately.
    scans_per_section = max(1, min(*survey.steps_each, SECTION_SCANS))
    sections = even_indices(-(-len(scans) // scans_per_section), SAMPLE_SECTIONS)
    firsts = scans.start + scans_per_section * sections
    return firsts, np.minimum(firsts + scans_per_section, scans.stop)


def _with_few_rays(survey: Survey, every: int) -> list[Mounted]:
    """Return the sensors of a survey with only one in `every` of their rays."""
    return [
        replace(mounted, sensor=_FewRays.from_sensor(mounted.sensor, every), steps=steps)
        for mounted, steps in zip(survey.mounted_sensors, survey.steps_each, strict=True)
    ]


def _batches(rig: Rig, firsts: Ints, stops: Ints) -> Iterator[Any]:
    for first, stop in zip(firsts.tolist(), stops.tolist(), strict=True):
        yield from rig.cast(first, stop)


class _SampledRays(NamedTuple):
    """Sample of k rays of a sensor."""

    firings: Ints  # (f,): distinct firings of the rays
    row: Ints  # (k,): index into `firings` for each ray
    channel: Ints  # (k,)


@dataclass(frozen=True, eq=False)
class _FewRays(Sensor):
    """A sensor with a single beam, whose firings are a sample of another sensor's rays."""

    sampled: Sensor = field(default_factory=Sensor)
    every: int = 1  # number of the sensor's rays for each sampled ray
    period = None

    @classmethod
    def from_sensor(cls, sensor: Sensor, every: int) -> _FewRays:
        """Sample one in `every` of a sensor's rays, or more if a scan would otherwise be empty."""
        first, stop = sensor.firings(0)
        # Scans may differ by one firing.
        every = max(1, min(every, (stop - first) * sensor.channels // 2))
        return cls(
            beams=Beams(np.zeros(1)),
            head=sensor.head,
            min_range_m=sensor.min_range_m,
            max_range_m=sensor.max_range_m,
            name="",
            optics=sensor.optics,
            start_ns=0.0,
            sampled=sensor,
            every=every,
        )

    def firings(self, step: int) -> tuple[int, int]:
        """Return the range of sampled rays in a time step."""
        first, stop = self.sampled.firings(step)
        channels = self.sampled.channels
        return first * channels // self.every, stop * channels // self.every

    def _rays(self, firings: Ints) -> _SampledRays:
        """Return the ray of the original sensor that each firing samples."""
        # Multiples of the golden ratio spread the rays evenly over firings and channels.
        ray = firings * self.every + (firings * GOLDEN % 1 * self.every).astype(np.int64)
        fired, channel = np.divmod(ray, self.sampled.channels)
        return _SampledRays(*np.unique(fired, return_inverse=True), channel)

    def directions(self, firings: Ints) -> Floats:
        """Return the directions of sampled rays in the sensor frame.

        The shape is (k, 1, 3).
        """
        rays = self._rays(firings)
        return self.sampled.directions(rays.firings)[rays.row, rays.channel, None]

    def origins(self, firings: Ints) -> Floats | None:
        """Return the origins of sampled rays, or None if all rays start at the sensor."""
        rays = self._rays(firings)
        origins = self.sampled.origins(rays.firings)
        return None if origins is None else origins[rays.row, rays.channel, None]

    @property
    def has_blocked_directions(self) -> bool:
        """Whether the platform blocks any directions of the sampled sensor."""
        return self.sampled.has_blocked_directions

    def is_blocked(self, firings: Ints, channels: Ints) -> Bools:
        """Return whether the platform blocks sampled rays."""
        rays = self._rays(firings)
        return self.sampled.is_blocked(rays.firings[rays.row], rays.channel)

    def begins_ns(self, firings: Ints) -> Floats:
        """Return the start time, in nanoseconds, of each sampled ray's firing."""
        rays = self._rays(firings)
        return self.sampled.begins_ns(rays.firings)[rays.row] + self.sampled.lead_ns
