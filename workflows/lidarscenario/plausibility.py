"""Warnings about implausible poses, motions and noise, which are probably mistakes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from lidarscenes.procedural.surroundings import EnclosingBody, PlacementChecker
from lidarsim.casting.visibility import static_key, unseen_objects, without_objects
from lidarsim.motion.rotations import matrices, quaternions_of
from lidarsim.motion.trajectory import Track, full_poses, velocities
from lidarsim.numerics.arrays import Bools, Floats
from lidarsim.numerics.even_samples import even_indices
from lidarsim.scene.actors import Actor
from lidarsim.scene.scene import Scene
from lidarsim.sensor.sensor import LineSensor
from lidarsim.simulator.sampling import sample_near_surfaces
from lidarsim.survey.survey import Survey
from lidarsim.words import format_as_scenario, format_rounded, printable

from .default_poses import (
    as_yaml_line,
    build_placement_checker,
    find_free_position_above,
    outside_view_hint,
)
from .prepare import PreparedScenario

GROUND_SPEED_M_S = 150.0  # faster than trains, except on test tracks
AIR_SPEED_M_S = 350.0  # faster than the aircraft that carry lidars
AIRBORNE_M = 50.0  # minimum height above the ground at which a platform is airborne
MAX_RATE_DEG_S = 720.0  # two rotations per second
NOISE_SHARE = 0.1  # maximum noise relative to the range

# A platform faces away from its direction of travel if the mean angle is larger than the first
# value and constant. The constancy is the length of the mean of unit vectors with these angles.
_ASKEW_DEG = 30.0
_CONSTANT = 0.95
# Below this speed, or on shorter paths, the direction of travel is dominated by noise.
_MOVES_M_S = 0.1
_TRAVELS_M = 2.0
# Mean cosine between the z axis and vertical, above which a platform is level, and below which it
# lies on its side.
_LEVEL = 0.9
_TILTED = 0.5
# z is probably not the up axis if the path extends over more than `_RISE_M` along z, if it climbs
# and descends by more than `_RISE_SHARE` of its length, and if its extent along x or y is less than
# `_FLAT` of its extent along z.
_RISE_M = 5.0
_RISE_SHARE = 0.3
_FLAT = 0.1

_NEAR_SHARE = 0.01  # fraction of the points behind close surfaces that is reported
_POSITIONS = 24  # number of sampled sensor positions
_TIMES = 20_000  # number of sampled times on a trajectory
_FAR_PERCENT = 95  # percentile of distances that replaces a missing range limit


class _Motion(NamedTuple):
    """Motion of the platform halfway between the poses of its trajectory."""

    times_ns: Floats  # (k,)
    durations_s: Floats  # (k,), time between the poses
    positions: Floats  # (k, 3), meters
    rotations: Floats  # (k, 3, 3), from the platform frame to the scene frame
    velocities: Floats  # (k, 3), m/s
    rates: Floats  # (k, 3), rad/s

    @property
    def speeds(self) -> Floats:
        """Speed of the platform in m/s.

        The array has shape (k,).
        """
        return np.asarray(np.linalg.norm(self.velocities, axis=1))


class _SensorPosition(NamedTuple):
    """Position of a sensor at a given time."""

    time_ns: float
    position: Floats  # (3,), local coordinates
    sensor: int  # index of the sensor
    station: int


def plausibility_warnings(prepared: PreparedScenario) -> list[str]:
    """Return warnings about implausible poses, motions, noise and coordinates.

    Default poses are not checked. Unless the scene has too many triangles, a few thousand rays are
    cast.
    """
    scene = prepared.scene.with_world_origin((0, 0, 0))  # in the coordinates of the scenario
    survey = prepared.survey
    chosen = prepared.scenario.poses is None and prepared.scenario.trajectory is None
    samples = [] if chosen else _sample_positions(survey)
    positions = np.array([sample.position for sample in samples]).reshape(-1, 3)
    surroundings = build_placement_checker(scene, positions) if samples else None
    warnings = [*filter(None, [prepared.job.location_warning])]
    visible_range_m = _visible_range_m(scene, surroundings, positions)
    warnings += [*_noise_warnings(survey, visible_range_m)]
    if not chosen:
        warnings += _position_warnings(scene, survey, surroundings, samples)
        if _is_near_sensor(scene, survey, surroundings, samples):
            warnings += _near_surface_warnings(scene, survey)
    if survey.path.moves:
        motion = _motion(survey)
        is_airborne = _is_airborne(scene, survey, surroundings, positions)
        warnings += _speed_warnings(motion, is_airborne=is_airborne)
        warnings += _up_axis_warnings(motion, scene.bounds[0, 2])
        warnings += _orientation_warnings(motion)
    return [format_as_scenario(warning) for warning in dict.fromkeys(warnings)]


# -- positions -------------------------------------------------------------------------------


def _sample_positions(survey: Survey) -> list[_SensorPosition]:
    """Return sample positions of all sensors in local coordinates."""
    path = survey.path
    mounts = [*enumerate(carried.mount for carried in survey.mounted_sensors)]
    if path.moves:
        times = np.linspace(0, min(path.duration_ns, survey.duration_ns), _POSITIONS)
        stations = [(0, time) for time in times.tolist()]
    else:
        stations = [(n, 0.0) for n in even_indices(path.stations, _POSITIONS).tolist()]
    stations = [stations[i] for i in even_indices(len(stations), max(1, _POSITIONS // len(mounts)))]
    return [
        _SensorPosition(
            time, np.array(path.pose(station, time).compose(mount).position), sensor, station
        )
        for station, time in stations
        for sensor, mount in mounts
    ]


def _position_warnings(
    scene: Scene,
    survey: Survey,
    surroundings: PlacementChecker | None,
    samples: list[_SensorPosition],
) -> Iterator[str]:
    """Yield warnings about sensors that are below the scene, or inside a closed body or actor.

    Objects that a sensor does not see are ignored.
    """
    unseen = unseen_objects(scene, survey)
    where = partial(_bad_positions, scene, samples, moves=survey.path.moves)
    if surroundings is not None:
        seen_by = _surroundings_of_sensors(scene, surroundings, samples, unseen)
        pairs = [(seen_by[sample.sensor], sample.position) for sample in samples]
        under = np.array([seen is not None and seen.is_covered(xyz) for seen, xyz in pairs])
        inside = np.array([seen is not None and seen.is_inside_body(xyz) for seen, xyz in pairs])
        if under.any():
            first = samples[int(under.argmax())]
            seen = seen_by[first.sensor]
            assert seen is not None  # because the sensor is below visible objects
            free = (
                None if survey.path.moves else find_free_position_above(scene, seen, first.position)
            )
            yield (
                f"the sensor is below the scene{where(under)}. Check z, the heights and `up_axis`"
                f"{_free_pose_hint(scene, survey, first, free)}"
            )
        inside &= ~under
        if inside.any():
            first = samples[int(inside.argmax())]
            seen = seen_by[first.sensor]
            assert seen is not None  # because the sensor is inside a visible body
            body = seen.find_enclosing_body(first.position)
            advice = _exit_advice(scene, survey, seen, first, body)
            yield (
                f"the sensor is inside the closed body {printable(body.name)!r}{where(inside)}. It "
                f"hits only the back faces of surfaces{advice}. If the body is the sensor "
                "housing, add its name to `unseen` of the sensor"
            )
    for actor, name in enumerate(scene.object_names[len(scene.names) :]):
        masks = (unseen[sample.sensor] for sample in samples)
        is_seen = [mask is None or not mask[len(scene.names) + actor] for mask in masks]
        inside = _inside_actor(scene.actors[actor], samples) & is_seen
        if inside.any():
            yield (
                f"the sensor is inside {name}{where(inside)}. Check its mount and the "
                "trajectories, or add the name to `unseen` of the sensor"
            )


def _exit_advice(
    scene: Scene,
    survey: Survey,
    seen: PlacementChecker,
    first: _SensorPosition,
    body: EnclosingBody,
) -> str:
    """Return a hint on how to move a sensor out of a body.

    The hint starts with a period, so that it can be appended to a sentence.
    """
    if not survey.path.moves:
        if (free := seen.find_free_position(first.position)) is not None:
            return _free_pose_hint(scene, survey, first, free)
        if body.is_whole_scene:
            return f". {outside_view_hint(scene, survey.mounted_sensors[0])}"
    lower, upper = (", ".join(f"{x:,.2f}" for x in corner) for corner in body.bounds + scene.origin)
    return f". The body extends from ({lower}) to ({upper})"


def _free_pose_hint(
    scene: Scene, survey: Survey, sample: _SensorPosition, free: Floats | None
) -> str:
    """Return a hint with the pose that moves the sensor to a free position.

    The hint starts with a period, so that it can be appended to a sentence. It is empty if `free`
    is None.
    """
    if free is None:
        return ""
    pose = survey.path.pose(sample.station).position + scene.origin + free - sample.position
    number = f" for pose {sample.station + 1}" * (survey.path.stations > 1)
    return (
        f". The nearest free position found{number} is {as_yaml_line(np.round(pose, 2).tolist())}"
    )


def _surroundings_of_sensors(
    scene: Scene,
    surroundings: PlacementChecker,
    samples: list[_SensorPosition],
    unseen: Sequence[Bools | None],
) -> list[PlacementChecker | None]:
    """Return a checker for each sensor, which contains only the objects that the sensor sees.

    An entry is None if the sensor sees no objects. `surroundings` contains all objects, and
    `unseen` contains a mask of the invisible objects for each sensor.
    """
    known: dict[bytes, PlacementChecker | None] = {b"": surroundings}
    keys = [static_key(scene, mask) for mask in unseen]
    for key, mask in zip(keys, unseen, strict=True):
        if mask is not None and key not in known:
            seen = without_objects(scene, mask)
            positions = np.array([sample.position for sample in samples])
            known[key] = None if seen is None else build_placement_checker(seen, positions)
    return [known[key] for key in keys]


def _bad_positions(
    scene: Scene, samples: list[_SensorPosition], is_bad: Bools, *, moves: bool
) -> str:
    """Describe how many positions are bad, and the first of them.

    If the platform moves, the description includes the time since the start of the survey.
    """
    first = samples[int(is_bad.argmax())]
    x, y, z = first.position + scene.origin
    share = f" at {is_bad.sum()} of {len(is_bad)} tested positions, first" * (not is_bad.all())
    time = f", {format_rounded(first.time_ns / 1e9, 4)} s after the start" * moves
    return f"{share} at ({x:,.3f}, {y:,.3f}, {z:,.3f}){time}"


def _is_near_sensor(
    scene: Scene,
    survey: Survey,
    surroundings: PlacementChecker | None,
    samples: list[_SensorPosition],
) -> bool:
    """Return whether a surface may be closer to a sensor than its minimum range."""
    nearest_m = np.array([one.sensor.min_range_m for one in survey.mounted_sensors])
    limits_m = nearest_m[[sample.sensor for sample in samples]]
    if surroundings is None or not limits_m.any():
        return False
    positions = np.array([sample.position for sample in samples])
    distances = surroundings.cast_around(positions).distance.reshape(len(samples), -1)
    if (distances.min(axis=1) < limits_m).any():
        return True
    for actor in scene.actors:
        local = _in_actor_frame(actor, samples)
        gaps = np.maximum(actor.mesh.bounds[0] - local, local - actor.mesh.bounds[1])
        if (np.linalg.norm(np.maximum(gaps, 0), axis=1) < limits_m).any():
            return True
    return False


def _near_surface_warnings(scene: Scene, survey: Survey) -> Iterator[str]:
    """Yield warnings about points behind surfaces that are closer than the minimum range."""
    found = sample_near_surfaces(scene, survey)
    for carried, near in zip(survey.mounted_sensors, found, strict=True):
        if near is None or near.points < _NEAR_SHARE:
            continue
        name = printable(near.name)
        yield (
            f"{near.points:.0%} of the points{f' of {carried.name}' * bool(carried.name)} are "
            f"behind surfaces that are closer than the minimum range of "
            f"{carried.sensor.min_range_m:g} m, such as {name!r} at "
            f"{format_rounded(near.distance_m)} m. Rays pass through such surfaces. Change `mount` "
            f"or the poses. If the object is the housing or the window of the sensor, add {name!r} "
            "to `unseen` of the sensor. If the vehicle blocks these rays, set `blocked_deg` in "
            "the sensor file to their directions"
        )


def _inside_actor(actor: Actor, samples: list[_SensorPosition]) -> Bools:
    """Mark the sensor positions that are inside the closed mesh of an actor.

    The mask has shape (k,).
    """
    inside = np.zeros(len(samples), np.bool_)
    if not samples:
        return inside
    local = _in_actor_frame(actor, samples)
    lower_m, upper_m = actor.mesh.bounds
    in_bounds = np.flatnonzero(((local > lower_m) & (local < upper_m)).all(axis=1))
    if len(in_bounds):
        surroundings = PlacementChecker(Scene.from_meshes([actor.mesh]))
        inside[in_bounds] = [surroundings.cast_around(local[k]).is_inside_body for k in in_bounds]
    return inside


def _in_actor_frame(actor: Actor, samples: list[_SensorPosition]) -> Floats:
    """Return the positions of sensors in the frame of an actor. Shape (k, 3)."""
    times = np.array([sample.time_ns for sample in samples])
    positions, rotations = full_poses(actor.trajectory, 0, times)
    offsets = np.array([sample.position for sample in samples]) - positions
    return np.asarray(np.einsum("kji,kj->ki", rotations, offsets))


# -- noise -----------------------------------------------------------------------------------


def _visible_range_m(
    scene: Scene, surroundings: PlacementChecker | None, positions: Floats
) -> float:
    """Return a typical distance to the farthest surfaces of the scene.

    It is used for sensors that have no range limit.
    """
    if surroundings is not None:
        distances = surroundings.cast_around(positions).distance
        if len(distances := distances[np.isfinite(distances)]):
            return float(np.percentile(distances, _FAR_PERCENT))
    return float(np.linalg.norm(np.ptp(scene.bounds, axis=0)))


def _noise_warnings(survey: Survey, visible_range_m: float) -> Iterator[str]:
    """Yield warnings about noise that is greater than a tenth of the range."""
    for carried, noise in zip(survey.mounted_sensors, survey.noise_each, strict=True):
        range_m = min(carried.sensor.max_range_m, visible_range_m)
        name = f" of {carried.name}" * bool(carried.name)
        for field in ("range_m", "range_at_threshold_m", "channel_bias_m", "warm_up_m"):
            value = float(np.max(np.abs(getattr(noise, field))))
            if value > NOISE_SHARE * range_m:
                yield (
                    f"`noise.{field}`{name} is {format_rounded(value, 4)} m, which is more than a "
                    f"tenth of the range ({format_rounded(range_m, 4)} m). Check that it is in "
                    "meters"
                )
        if noise.range_per_m > NOISE_SHARE:
            yield (
                f"`noise.range_per_m`{name} is {noise.range_per_m:g}, which is more than a tenth "
                "of the range. Check that it is in meters per meter of range"
            )


# -- motion ----------------------------------------------------------------------------------


def _motion(survey: Survey) -> _Motion:
    """Return the motion of the platform, including the path after the last scan."""
    path = survey.path
    end_ns = path.duration_ns if np.isfinite(path.duration_ns) else survey.duration_ns
    if isinstance(path, Track):
        assert path.start_s is not None  # set by Track.__post_init__
        knots = (path.times_s - path.start_s) * 1e9
        knots = np.unique(np.clip(knots, 0.0, end_ns))
    else:
        knots = np.linspace(0.0, end_ns, _TIMES)
    rows = even_indices(len(knots) - 1, _TIMES)
    times = (knots[rows] + knots[rows + 1]) / 2
    durations_s = np.diff(knots)[rows] / 1e9
    return _Motion(times, durations_s, *full_poses(path, 0, times), *velocities(path, 0, times))


def _is_airborne(
    scene: Scene, survey: Survey, surroundings: PlacementChecker | None, positions: Floats
) -> bool:
    """Return whether the platform is airborne.

    A platform is airborne if it carries a line scanner or is high above the ground.
    """
    if any(isinstance(carried.sensor, LineSensor) for carried in survey.mounted_sensors):
        return True
    heights = positions[:, 2] - scene.bounds[1, 2]
    if surroundings is not None and len(positions):
        down = np.broadcast_to([0.0, 0.0, -1.0], positions.shape)
        below = surroundings.cast(positions, down).distance
        heights = np.where(np.isfinite(below), below, heights)
    return bool(len(heights) and np.median(heights) > AIRBORNE_M)


def _speed_warnings(motion: _Motion, *, is_airborne: bool) -> Iterator[str]:
    """Yield warnings about speeds and angular rates that no platform reaches."""
    limit_m_s = AIR_SPEED_M_S if is_airborne else GROUND_SPEED_M_S
    medium = "in the air" if is_airborne else "on the ground"
    speeds = motion.speeds
    rates = np.degrees(np.linalg.norm(motion.rates, axis=1))
    if (speeds > limit_m_s).any():
        fastest = int(speeds.argmax())
        yield (
            f"the platform moves at {format_rounded(speeds[fastest], 4)} m/s at "
            f"{_time(motion, fastest)}, but platforms {medium} do not exceed {limit_m_s:g} m/s. "
            "Check the units of positions and times"
        )
    if (rates > MAX_RATE_DEG_S).any():
        fastest = int(rates.argmax())
        yield (
            f"the platform rotates at {format_rounded(rates[fastest], 4)} degrees per second at "
            f"{_time(motion, fastest)}, but platforms do not exceed {MAX_RATE_DEG_S:g} degrees per "
            "second. Check the times, and the units and the order of angles or quaternions"
        )


def _time(motion: _Motion, row: int) -> str:
    return f"{format_rounded(motion.times_ns[row] / 1e9, 4)} s"


def _up_axis_warnings(motion: _Motion, lowest_m: float) -> Iterator[str]:
    """Yield a warning if the path is steep along z but flat along x or y.

    Vertical paths, such as those of elevators and drones, are plausible unless they extend below
    the scene.
    """
    extent_m = np.ptp(motion.positions, axis=0)
    length_m = motion.speeds @ motion.durations_s
    climb_m = np.abs(motion.velocities[:, 2]) @ motion.durations_s
    flat_axis = int(extent_m[:2].argmin())
    if extent_m[:2].max() < _FLAT * extent_m[2] and motion.positions[:, 2].min() >= lowest_m:
        return
    if (
        extent_m[2] > _RISE_M
        and climb_m > _RISE_SHARE * length_m
        and extent_m[flat_axis] < _FLAT * extent_m[2]
    ):
        yield (
            f"the trajectory extends over {format_rounded(extent_m[2], 4)} m along z, but only "
            f"over {format_rounded(extent_m[flat_axis])} m along {'xy'[flat_axis]}. Positions must "
            f"be in meters with z up. Check whether {'xy'[flat_axis]} is the up axis of its file"
        )


def _orientation_warnings(motion: _Motion) -> Iterator[str]:
    """Yield a warning if the platform lies on its side or faces away from its path."""
    as_read = _MeanOrientation.measure(motion, motion.rotations)
    # If the quaternions in the file have the order w, x, y, z, then w was read as x, x as y, and so
    # on.
    quaternions = quaternions_of(motion.rotations)
    w_first = _MeanOrientation.measure(motion, matrices(quaternions[:, [1, 2, 3, 0]]))
    tilted = as_read.level <= _TILTED
    is_w_first = as_read.level <= _LEVEL < w_first.level and not w_first.is_askew
    if not (tilted or as_read.is_askew or is_w_first):
        return
    faults = []
    if tilted or is_w_first:
        tilt = np.degrees(np.arccos(np.clip(as_read.level, -1, 1)))
        faults.append(f"the z axis of the platform is tilted by {tilt:.0f} degrees from vertical")
    if as_read.is_askew:
        faults.append(
            f"the platform constantly faces {abs(as_read.angle_deg):.0f} degrees to the "
            f"{'left' if as_read.angle_deg > 0 else 'right'} of its direction of travel"
        )
    advice = "Check the order of quaternions (x, y, z, w) and the units and axes of angles"
    if is_w_first:
        advice = (
            "Its quaternions are probably in the order w, x, y, z, because in that order the "
            "platform is level and faces its direction of travel. Use the order x, y, z, w"
        )
    elif not tilted:
        advice += ". If the sensor is mounted at this angle, set the angle in its `mount`"
    yield f"{' and '.join(faults)}. {advice}"


class _MeanOrientation(NamedTuple):
    """Mean orientation of a platform along its path."""

    level: float  # mean cosine between the z axis of the platform and vertical
    angle_deg: float  # mean angle from the direction of travel to the x axis, positive to the left
    constancy: float  # constancy of that angle, from 0 to 1; 0 if the platform hardly moves

    @property
    def is_askew(self) -> bool:
        """Whether the platform constantly faces away from its direction of travel."""
        return self.constancy > _CONSTANT and abs(self.angle_deg) > _ASKEW_DEG

    @classmethod
    def measure(cls, motion: _Motion, rotations: Floats) -> _MeanOrientation:
        """Return the mean orientation along a path.

        `rotations` has shape (k, 3, 3).
        """
        level = float(np.average(rotations[:, 2, 2], weights=motion.durations_s))
        forward = rotations[:, :2, 0]
        travel = motion.velocities[:, :2]
        speeds = np.linalg.norm(travel, axis=1)
        lengths_m = np.where(speeds > _MOVES_M_S, speeds * motion.durations_s, 0.0)
        if lengths_m.sum() < _TRAVELS_M:
            return cls(level, 0.0, 0.0)
        sines = travel[:, 0] * forward[:, 1] - travel[:, 1] * forward[:, 0]
        cosines = (travel * forward).sum(axis=1)
        angles = np.arctan2(sines, cosines)
        mean = np.average(np.exp(1j * angles), weights=lengths_m)
        return cls(level, float(np.degrees(np.angle(mean))), float(np.abs(mean)))
