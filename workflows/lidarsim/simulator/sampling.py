"""Estimates of a survey from some of its rays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from raybeam import available_backends

from ..base.arrays import Floats, Ints
from ..base.declared import declared
from ..base.sampling import even_indices
from ..scene.scene import Scene
from ..sensor import Mounted, Noise, Returns, Sensor, Survey
from ..sensor.beams import Beams
from ..sensor.weather import Weather
from .rig import Rig

SAMPLE_RAYS = 500_000  # rays that are cast at most
SAMPLE_PARTS = 500  # parts of a survey that rays are cast of, at most
SAMPLE_SCANS = 40  # consecutive scans of a part
RANGE_RAYS = 20_000  # rays that `sample_ranges` casts, at most
GOLDEN = 0.6180339887498949  # the golden ratio less 1


def sample_survey(scene: Scene, survey: Survey, backend: str = "auto") -> dict[str, int]:
    """Estimate hits and points of a survey by casting some of its rays, all if they are few.

    The rays are spread evenly over all scans; of many thousand scans, over some of each part. The
    result also has the number of rays that were cast.
    """
    firsts, stops = _sampled_scans(survey, range(survey.scan_count))
    subrays = max(returns.subrays for returns in survey.returns_each)
    rays = survey.ray_count * subrays * int((stops - firsts).sum()) // survey.scan_count
    sampled = survey
    if (every := -(-rays // SAMPLE_RAYS)) > 1:
        # Faults and errors of certain channels do not fit one beam.
        other: dict[str, Any] = {"channel_bias_m": 0.0, "ripple_deg": 0.0}
        carried = [
            replace(one, noise=one.noise and replace(one.noise, **other))
            for one in _with_few_rays(survey, every)
        ]
        noise = replace(survey.noise, **other)
        sampled = replace(survey, sensors=carried, noise=noise, faults=())
    cast = whole = hits = points = 0
    for batch in _batches(Rig(scene, sampled, backend), firsts, stops):
        every = getattr(sampled.carried[batch.specs[0].sensor].sensor, "every", 1)
        rays = sum(spec.ray_count for spec in batch.specs)
        cast = cast + rays
        whole = whole + rays * every
        hits += int(batch.hits.sum()) * every
        points += int(np.ceil(batch.hits * every / survey.keep_every).sum())
    share = survey.ray_count / whole
    return {"rays": cast, "hits": round(hits * share), "points": round(points * share)}


def sample_ranges(scene: Scene, survey: Survey, scans: range | None = None) -> Floats:
    """Return the distances at which some rays of a survey meet their nearest surfaces, metres.

    Sensors see near and far without limits, noise, faults and weather. Rays that meet nothing are
    left out: (n,). `scans` chooses scans of the survey, by default all.
    """
    firsts, stops = _sampled_scans(survey, range(survey.scan_count) if scans is None else scans)
    rays = survey.ray_count * int((stops - firsts).sum()) // survey.scan_count
    carried = [
        replace(
            one,
            sensor=replace(one.sensor, min_range_m=0.0, max_range_m=np.inf),
            noise=Noise(),
            returns=Returns(),
        )
        for one in _with_few_rays(survey, max(1, -(-rays // RANGE_RAYS)))
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
        **declared(Weather(), Weather),
    )
    # Never CUDA, whose context would stay in this process.
    backend = "numpy" if available_backends()["embree"] else "embree"
    batches = _batches(Rig(scene, plain, backend), firsts, stops)
    return np.concatenate([np.zeros(0), *(batch.range for batch in batches)])


def _sampled_scans(survey: Survey, scans: range) -> tuple[Ints, Ints]:
    """Return the first scans of the parts that rays are cast of, and the scans behind them."""
    # Of at most two stations: a cast of each.
    scans_per_part = max(1, min(*survey.steps_each, SAMPLE_SCANS))
    parts = even_indices(-(-len(scans) // scans_per_part), SAMPLE_PARTS)
    firsts = scans.start + scans_per_part * parts
    return firsts, np.minimum(firsts + scans_per_part, scans.stop)


def _with_few_rays(survey: Survey, every: int) -> list[Mounted]:
    """Return the sensors of a survey with one of `every` rays, and their time steps."""
    return [
        replace(one, sensor=_FewRays.of(one.sensor, every), steps=steps)
        for one, steps in zip(survey.carried, survey.steps_each, strict=True)
    ]


def _batches(rig: Rig, firsts: Ints, stops: Ints) -> Iterator[Any]:
    """Cast parts of a survey."""
    for first, stop in zip(firsts.tolist(), stops.tolist(), strict=True):
        yield from rig.cast(first, stop)


@dataclass(frozen=True, eq=False)
class _FewRays(Sensor):
    """A sensor of one beam, whose firings are some rays of another: one of each `every`."""

    whole: Sensor = field(default_factory=Sensor)
    every: int = 1
    period = None

    @classmethod
    def of(cls, sensor: Sensor, every: int) -> _FewRays:
        """Take one of so many rays, but some of each scan, though it may have a firing less."""
        first, stop = sensor.firings(0)
        every = max(1, min(every, (stop - first) * sensor.channels // 2))
        near = sensor.min_range_m
        far = sensor.max_range_m
        beams = Beams(np.zeros(1))
        return cls(beams, sensor.head, near, far, "", sensor.optics, 0.0, sensor, every)

    def firings(self, step: int) -> tuple[int, int]:
        first, stop = self.whole.firings(step)
        channels = self.whole.channels
        return first * channels // self.every, stop * channels // self.every

    def _rays(self, firings: Ints) -> tuple[Ints, ...]:
        """Return firings of the other, and which of these and which channel each ray is of."""
        # Steps of the golden ratio spread the rays evenly over firings and channels.
        ray = firings * self.every + (firings * GOLDEN % 1 * self.every).astype(np.int64)
        fired, channel = np.divmod(ray, self.whole.channels)
        return *np.unique(fired, return_inverse=True), channel

    def directions(self, firings: Ints) -> Floats:
        some, row, channel = self._rays(firings)
        return self.whole.directions(some)[row, channel, None]

    def origins(self, firings: Ints) -> Floats | None:
        some, row, channel = self._rays(firings)
        starts = self.whole.origins(some)
        return None if starts is None else starts[row, channel, None]

    def begins_ns(self, firings: Ints) -> Floats:
        some, row, _ = self._rays(firings)
        return self.whole.begins_ns(some)[row] + self.whole.lead_ns
