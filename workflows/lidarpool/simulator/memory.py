"""The memory that casting scans takes on a worker, beside that of its rig: an estimate."""

from __future__ import annotations

from bisect import bisect_right
from functools import partial

import numpy as np

from ..columns.table import VELOCITY
from ..columns.waveforms import record
from ..scene.scene import Scene
from ..sensor import Sensor, Survey
from .device import needs_hits
from .echoes import CHUNK_RAYS
from .rig import rays_repeat
from .waveform import BLOCK_SAMPLES

MB = 1_000_000

# Bytes, measured in `Rig.cast` and `columns_of` as the peak of tracemalloc, at a million rays that
# all hit a sphere of 20,480 triangles: 128 beams and one, a prism, standing and moving, with all
# columns and none, 1 to 19 sub-rays, a glass sphere around the sensor, with Embree and NumPy, which
# differ by 30 MB at most (2026-11-22, Linux, NumPy 2.4). The estimate was 1.02 to 1.5 times that;
# 1.64 if two returns of a pulse may be reported and there is one, 0.8 if there are always two. The
# peak of the process (VmHWM) was 16 % above tracemalloc's at most, and mostly below.
# tests/lidarpool/test_memory.py measures some of it again.
RAY = 28  # its hit
RAY_MADE, RAY_MADE_KEPT = 92, 32  # if it is not repeated: while it is made, and after that
RAY_TURNED = 20  # by noise of angles, likewise
RAY_AMONG_BODIES = 70  # in a scene with instances or actors
POSE, POSE_KEPT = 140, 100  # of a firing that has its own: while it is made, and after that
# Of those cast at a time; if light passes or is reflected; if it is refracted.
SUBRAY, SUBRAY_PASSING, SUBRAY_REFRACTED = 200, 650, 1350
SUBRAY_MOVING = 200  # more of each, with radial velocities
# Of a ray that is cast at a time: false alarms and stray light, and each pulse of another sensor.
# Each return has a cause then.
RECEIVED, CROSSED, RETURN_CAUSED = 120, 370, 10
RETURN, RETURN_ALL, RETURN_KEPT = 30, 110, 40  # meanwhile; then, when all are counted and thinned
RETURNS = 1.5  # of a pulse, where all or two are reported; 1.1 to 1.6 in generated woods
RETURNS_LEAFY = 4  # where all are, and each sub-ray meets a leaf by itself; 3.3 in a high canopy
AIR, AIR_HIT = 110, 170  # of a sub-ray where the air returns light; a hit in the air
POINT, POINT_BYTE = 64, 3.2  # a point, and each byte of its columns: their sources are float64
COLOUR = 16  # of a ray, where its colour is its reflectance
# A byte of recorded waveforms, of all returns, and a sample of those made at a time.
RECORDED, SAMPLED = 2.3, 40
# Copies of what a device has made: CuPy rounds page-locked memory up to powers of two, and columns
# of several runs of scans, by station and sensor, are joined.
PAGE_LOCKED, JOINED = 2, 1
SCAN, STATION = 500, 6000  # their descriptions, poses and small arrays
TRIANGLE = 16  # a count of hits, twice


def cast_bytes(scene: Scene, survey: Survey, scans: int = 1, *, on_device: bool = False) -> int:
    """Most memory that casting so many scans and making their columns takes, if all rays hit.

    They are scans of the sensor for which it is most; columns of a user's functions count as if
    they needed as much as others. `on_device` says that a CUDA device casts the rays; its own
    memory, some 300 MB, does not count.
    """
    leafy = any(material.leaf_area_density is not None for material in survey.materials)
    leafy |= bool(scene.has_voxels.any())
    passing = leafy or any(material.transparent != "none" for material in survey.materials)
    refracted = any(material.refractive_index is not None for material in survey.materials)
    dark = any(material.reflectance == 0 for material in survey.materials)
    textured = any(material.reflectance == "texture" for material in survey.materials)
    moving = any(column.name == VELOCITY for column in survey.stored_columns)
    bodies = bool(scene.actors or scene.instances)
    columns = sum(np.dtype(column.dtype).itemsize for column in survey.stored_columns)
    recorded = record(survey.waveform_samples).itemsize if survey.waveform_samples else 0
    plain = all(
        returns.subrays == 1 and returns.waveform == "none" and not (noise.loses or noise.displaces)
        for returns, noise in zip(survey.returns_each, survey.noise_each, strict=True)
    )
    made_there = on_device and plain and not (passing or dark or recorded)
    by_numpy = not made_there or needs_hits(survey)
    most = 0.0
    each = zip(
        survey.carried, survey.steps_each, survey.returns_each, survey.noise_each, strict=True
    )
    for number, (carried, steps, reported, noise) in enumerate(each):
        sensor, subrays = carried.sensor, reported.subrays
        waves = survey.waveform_samples > 0 or reported.waveform != "none"
        echoes = subrays > 1 or noise.loses or passing or dark or waves
        several = reported.mode in ("all", "dual") and (subrays > 1 or passing)
        first, stop = sensor.firings(0)
        firings = (stop - first) * scans
        rays = firings * sensor.channels
        in_leaves = leafy and subrays > 1 and reported.mode == "all"
        of_pulse = (RETURNS_LEAFY if in_leaves else RETURNS) if several else 1
        in_air = 0.0  # hits of a pulse
        if survey.returns_light:
            in_air = survey.met(number) + bool(survey.scatters(sensor.optics.wavelength_nm))
        more = {"all": in_air, "dual": min(in_air, 1.0)}.get(reported.mode, 0.0)
        if noise.false_alarm_hz:
            alarms = noise.false_alarm_hz * sensor.gate_s
            more += {"all": alarms, "dual": min(alarms, 1.0)}.get(reported.mode, 0.0)
        returns = rays * max(of_pulse, 1 + more)
        points = returns / survey.keep_every
        repeats, by_head = rays_repeat(sensor, survey.path.moves)
        poses = firings if survey.path.moves or by_head else 0
        here = 0 if made_there else rays  # rays whose hits are on the host
        made = 0 if repeats else rays
        turned = rays if noise.angle_deg and not echoes else 0
        kept: float = (
            (RAY + COLOUR * textured) * here + POSE_KEPT * poses + RAY_MADE_KEPT * max(made, turned)
        )
        casting = POSE * poses + RAY_MADE * made + RAY_TURNED * turned
        casting += RAY_AMONG_BODIES * (rays if scene.actors else here) * bodies
        if echoes:
            chunk = min(rays * subrays, CHUNK_RAYS)
            subray = SUBRAY_PASSING if passing else SUBRAY
            subray = (SUBRAY_REFRACTED if refracted else subray) + SUBRAY_MOVING * moving
            found = subray * chunk + RETURN * returns
            if noise.false_alarm_hz or noise.stray_light or noise.crosstalk:
                found += RECEIVED * chunk / subrays
                kept += RETURN_CAUSED * returns
            if noise.crosstalk:
                found += CROSSED * _others(survey, sensor) * chunk / subrays
            if survey.returns_light:
                found += AIR * chunk + AIR_HIT * in_air * chunk / subrays
            every = RETURN_ALL * returns + RETURN_KEPT * points
            if recorded:
                found += SAMPLED * min(chunk * survey.waveform_samples, BLOCK_SAMPLES)
                found += recorded * returns
                every += RECORDED * recorded * returns
            casting += max(found, every)
        if by_numpy:  # as if it made all columns, and once more those of the device
            point = POINT + POINT_BYTE * columns + columns * made_there
        else:
            one_run = scans <= steps and len(survey.carried) == 1
            point = (PAGE_LOCKED + (0 if one_run else JOINED)) * columns
        made_columns = point * points
        small = SCAN * scans + STATION * (1 + scans // steps)
        most = max(most, kept + max(casting, made_columns) + small)
    return int(most) + TRIANGLE * scene.counters


def _others(survey: Survey, sensor: Sensor) -> float:
    """Pulses of all sensors but one in the time in which that one fires once."""

    def rate(one: Sensor) -> float:
        first, stop = one.firings(0)
        begin, end = one.begins_ns(np.array([first, stop], np.int64))
        return float((stop - first) * one.channels / (end - begin))

    every = sum(rate(carried.sensor) for carried in survey.carried)
    return every / rate(sensor) - 1


def scans_that_fit(scene: Scene, survey: Survey, limit: float, *, on_device: bool = False) -> int:
    """Find how many scans can be cast at a time in so many bytes, at least 1; see `cast_bytes`.

    Of a small survey these may be more than it has. The counts of hits do not count: each cast
    takes them, and smaller ones would take no less.
    """
    limit += TRIANGLE * scene.counters
    takes = partial(cast_bytes, scene, survey, on_device=on_device)
    if (whole := takes(survey.scan_count)) <= limit:
        return int(survey.scan_count * limit / whole)
    return max(1, bisect_right(range(1, survey.scan_count + 1), limit, key=takes))
