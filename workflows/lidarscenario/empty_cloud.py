"""Determine why a survey produces no points."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from lidarfiles.datasets.job_table import JobRow
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.scene import Scene
from lidarsim.simulator.sampling import sample_ranges
from lidarsim.survey.survey import Survey
from lidarsim.words import format_rounded, join_names, plural

from .default_poses import outside_view_hint

EMPTY = "the cloud has no points"
NO_POINTS = "no points: "  # precedes the names of jobs
NAMED_JOBS = 5  # maximum number of job names in a warning

# For larger scenes, building a ray caster takes too long for a warning.
MAX_TRIANGLES = 2_000_000


def empty_cloud_reason(scene: Scene, survey: Survey, scans: range | None = None) -> str:
    """Return the most likely reason why a survey produces no points.

    A sample of rays is cast without range limits and effects. If none of them hits a surface, the
    reason is probably a pose or the unit of the scene. Otherwise, it is probably a range limit or
    an effect. The returned text has no final period.

    Parameters
    ----------
    scene, survey
        Scene and survey of the job.
    scans
        Scans that were simulated (default: all).
    """
    # Poses in the reason are in the coordinates of the scenario.
    scene = scene.with_world_origin((0, 0, 0))
    if survey.scan_count == 0 or (scans is not None and not len(scans)):
        return "no scan was cast"
    if scene.triangles > MAX_TRIANGLES:
        return f"check the ranges, poses and units. {_start_position(scene, survey)}"
    ranges = sample_ranges(scene, survey, scans)
    if not len(ranges):
        faults = "faults, " * bool(survey.faults)
        unseen = "unseen, " * any(carried.unseen for carried in survey.mounted_sensors)
        poses_note = outside_view_hint(scene, survey.mounted_sensors[0])
        return (
            f"no ray hits a surface at any distance. Check {unseen}{faults}poses and units. "
            f"{_start_position(scene, survey)}. {poses_note}"
        )
    limits = [*dict.fromkeys(_limits(survey, ranges))]
    if not limits:
        suspects = join_names([*_effects(survey)]) or "the surfaces"
        return (
            f"rays hit surfaces at ranges from {_span(ranges)}, but no return is reported. "
            f"Check {suspects}"
        )
    clauses = ", and ".join(limits)
    return f"{clauses}. Check the ranges, poses and units. {_start_position(scene, survey)}"


def empty_jobs_warning(empty: Sequence[JobRow], reason: str) -> str:
    """Return a warning that lists the jobs without points.

    `reason` is the most likely reason for the first job, or an empty string.
    """
    names = ", ".join(row.name for row in empty[:NAMED_JOBS])
    if unnamed := len(empty) - NAMED_JOBS:
        names += f" and {unnamed:,} more" * (unnamed > 0)
    jobs = f"{plural(len(empty), 'job has', 'jobs have')} {NO_POINTS}{names}"
    advice = "To see the most likely reason, run `lidarpool check CAMPAIGN --job N`"
    return f"{jobs}. Job {empty[0].name}: {reason}" if reason else f"{jobs}. {advice}"


def _limits(survey: Survey, ranges: Floats) -> Iterator[str]:
    """Yield clauses about the sensors' range limits if these exclude all surfaces."""
    lower = [carried.sensor.min_range_m for carried in survey.mounted_sensors]
    upper = [carried.sensor.max_range_m for carried in survey.mounted_sensors]
    too_close = ranges < min(lower)
    too_far = ranges > max(upper)
    if not (too_close | too_far).all():
        return
    if too_close.any():
        yield (
            f"{'all' if too_close.all() else 'some'} surfaces are closer than `min_range_m` "
            f"({min(lower):g} m), at ranges from {_span(ranges[too_close])}"
        )
    if too_far.any():
        yield (
            f"{'all' if too_far.all() else 'some'} surfaces are farther than `max_range_m` "
            f"({max(upper):g} m), at ranges from {_span(ranges[too_far])}"
        )


def _effects(survey: Survey) -> Iterator[str]:
    """Yield the names of settings that could suppress all returns."""
    if any(noise.detection_range_m is not None for noise in survey.noise_each):
        yield "noise.detection_range_m"
    if any(noise.dropout for noise in survey.noise_each):
        yield "noise.dropout"
    if survey.faults:
        yield "faults"
    if survey.extinction(survey.mounted_sensors[0].sensor):
        yield "weather"
    if survey.materials:
        yield "materials"
    if survey.keep_every > 1:
        yield "cloud.keep_every"


def _span(ranges: Floats) -> str:
    return f"{format_rounded(np.min(ranges), 4)} to {format_rounded(np.max(ranges), 4)} m"


def _start_position(scene: Scene, survey: Survey) -> str:
    (x, y, z) = survey.pose(0).position + scene.origin
    return f"The sensor starts at ({x:,.3f}, {y:,.3f}, {z:,.3f})"
