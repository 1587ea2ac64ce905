"""Comparison of what programs have read with the simulated clouds and trajectories."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np

from lidarfiles.clouds.intensity_full_scale import compute_full_scale
from lidarsim.numerics.arrays import AnyArray, Floats, Ints
from lidarsim.packets.encoders import START_NS

from .decoders_surveys import START, Drive

_GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
_LEAP_S = 18  # by which GPS time is ahead of UTC
_PACKET_FIRINGS = 24  # of Velodyne, in a packet at most
_CHANNELS = ("LIDAR_TOP", "rear")  # of the drive's sensors in nuScenes
_JOINED = 5  # sweeps that nuscenes-devkit joins

Arrays = dict[str, AnyArray]


class Row(NamedTuple):
    """Table row that states what was compared, how many items, and the maximum differences."""

    file: str
    things: str
    count: int
    differences: dict[str, str]  # by quantity, in words


def greatest(differences: AnyArray) -> float:
    """Return the maximum absolute value, or 0 if there are no values."""
    return float(np.abs(differences).max(initial=0))


def meters(length_m: float) -> str:
    """Format a length as text, for example '3.2 mm'."""
    for factor, unit in ((1, "m"), (1e3, "mm"), (1e6, "µm")):
        if factor * length_m >= 0.1:
            return f"{factor * length_m:.2g} {unit}"
    return f"{length_m:.0e} m" if length_m else "0"


def apart(first: Any, second: Any) -> str:
    """Return the maximum distance between corresponding points (n, 3), as text."""
    return meters(greatest(np.linalg.norm(np.asarray(first) - np.asarray(second), axis=1)))


def equality(first: Any, second: Any) -> str:
    """Return "equal", or how many values differ, as text."""
    wrong = np.count_nonzero(np.asarray(first) != np.asarray(second))
    return f"{wrong:,} differ" if wrong else "equal"


# -- packets ---------------------------------------------------------------------------------------


def compare_velodyne(drive: Drive, model: str, arrays: Arrays) -> Iterator[Row]:
    """Compare decoded points ring by ring, in order of time."""
    cloud = drive.cloud
    file = f"packets, {model}"
    times_s = arrays["times_s"] - START_NS / 1e9
    by_ring_and_time = np.lexsort((times_s, arrays["points"][:, 4]))
    rows = arrays["points"][by_ring_and_time].astype(np.float64)
    # Firings that do not fill a packet are not sent: they are the last.
    counts = np.bincount(rows[:, 4].astype(np.int64), minlength=drive.survey.sensor.channels)
    order = np.lexsort((cloud["time"], cloud["channel"]))
    ring = cloud["channel"][order].astype(np.int64)
    number_in_ring = np.arange(len(ring)) - np.searchsorted(ring, ring)
    sent = order[number_in_ring < counts[ring]]
    if len(sent) != len(rows) or len(ring) - len(sent) > _PACKET_FIRINGS * len(counts):
        yield Row(file, "points", len(rows), {"number": f"{len(ring):,} in the cloud"})
        return
    off_m = np.linalg.norm(rows[:, :3] - drive.as_fired[sent], axis=1)
    half = meters(float(np.median(off_m)))
    lag_us = 1e6 * greatest(times_s[by_ring_and_time] - cloud["time"][sent] / 1e9)
    differences = {
        "position": f"{meters(greatest(off_m))} (median {half})",
        "ring, reflectivity": equality(rows[:, 3], cloud["reflectivity"][sent]),
        "time": f"{lag_us:.1f} µs",
    }
    yield Row(file, "points", len(rows), differences)


def compare_ouster(drive: Drive, model: str, arrays: Arrays) -> Iterator[Row]:
    """Compare decoded points column by column, from the top beam to the bottom beam."""
    cloud = drive.cloud
    file = f"packets, {model}"
    rows = drive.survey.sensor.channels - 1 - cloud["channel"].astype(np.int64)
    order = np.lexsort((rows, cloud["time"]))
    count = len(arrays["rows"])
    if len(order) != count:
        yield Row(file, "points", count, {"number": f"{len(order):,} in the cloud"})
        return
    since_ns = arrays["times_ns"].astype(np.int64) - START_NS
    differences = {
        "position": apart(arrays["positions"], drive.as_fired[order]),
        "row": equality(rows[order], arrays["rows"]),
        "reflectivity": equality(arrays["reflectivity"], cloud["reflectivity"][order]),
        "time": equality(since_ns, cloud["time"][order].astype(np.int64)),
    }
    yield Row(file, "points", count, differences)


# -- nuScenes --------------------------------------------------------------------------------------


def compare_nuscenes(drive: Drive, arrays_of_files: Arrays) -> Iterator[Row]:
    """Compare the points, labels and boxes of a data set."""
    arrays = {name.partition("/")[2]: array for name, array in arrays_of_files.items()}
    yield _nuscenes_points(drive, arrays)
    yield _joined_sweeps(drive, arrays)
    actors = _actors_of(drive, arrays)
    yield _annotations(drive, arrays, actors)
    yield _boxes_of_key_frames(drive, arrays)
    yield _interpolated_boxes(drive, arrays, actors)


def _nuscenes_points(drive: Drive, arrays: Arrays) -> Row:
    """Compare the points and classes of all sweeps."""
    sweeps = drive.sweeps
    parts: dict[str, list[AnyArray]] = {"read": [], "true": [], "classes": []}
    for number in range(len(sweeps)):
        file = f"{_CHANNELS[sweeps.sensor[number]]}/{sweeps.numbers[number]:06}.pcd.bin"
        (name,) = (n for n in arrays if n.startswith("points/") and n.endswith(file))
        parts["read"].append(arrays[name][:, :3])
        parts["true"].append(sweeps.pose.to_body_frame(number, drive.in_world(number)))
        parts["classes"].append(arrays[name.replace("points/", "classes/", 1)])
    joined = {name: np.concatenate(arrays_of_sweeps) for name, arrays_of_sweeps in parts.items()}
    differences = {
        "position (`LidarPointCloud.from_file`)": apart(joined["read"], joined["true"]),
        "class (lidarseg)": equality(joined["classes"], drive.cloud["class"]),
    }
    return Row("`nuscenes`", "points", len(joined["read"]), differences)


def _joined_sweeps(drive: Drive, arrays: Arrays) -> Row:
    """Compare the first lidar's sweeps, which the devkit has merged into one cloud."""
    poses = drive.sweeps.pose
    off_m = []
    for number in range(int((drive.sweeps.sensor == 0).sum())):
        parts = []
        for earlier in range(number, max(number - _JOINED, -1), -1):
            in_world = drive.in_world(earlier)
            beside = np.abs(poses.to_body_frame(earlier, in_world)[:, :2]) < 1
            parts.append(in_world[~beside.all(axis=1)])  # the devkit leaves out the rest
        truth = poses.to_body_frame(number, np.concatenate(parts))
        off_m.append(np.linalg.norm(arrays[f"joined/{number}"][:, :3] - truth, axis=1))
    total = np.concatenate(off_m)
    differences = {"position (`from_file_multisweep`)": meters(greatest(total))}
    return Row("`nuscenes`", f"points, {_JOINED} sweeps joined", len(total), differences)


def _actors_of(drive: Drive, arrays: Arrays) -> Ints:
    """Return the index of the nearest actor of the same type for each annotation."""
    actors = []
    columns = (arrays[f"boxes/{name}"] for name in ("names", "times_s", "centers"))
    for name, time_s, center in zip(*columns, strict=True):
        candidates = [k for k, mover in enumerate(drive.movers) if mover.kind == name]
        expected = drive.centers(np.full(len(candidates), time_s), np.array(candidates))
        nearest = np.linalg.norm(expected - center, axis=1).argmin()
        actors.append(candidates[nearest])
    return np.array(actors)


def _annotations(drive: Drive, arrays: Arrays, actors: Ints) -> Row:
    """Compare the boxes, velocities and point counts of annotations."""
    times_s = arrays["boxes/times_s"]
    velocities = drive.velocities(actors)
    speeds = np.linalg.norm(velocities, axis=1)
    off = np.linalg.norm(arrays["boxes/velocities"] - velocities, axis=1) / speeds
    ahead = arrays["boxes/rotations"][:, :, 0]  # axes of the boxes, which are level
    headings = np.arctan2(ahead[:, 1], ahead[:, 0]) - np.arctan2(velocities[:, 1], velocities[:, 0])
    size_m = arrays["boxes/sizes"] - drive.sizes(actors)
    turned_deg = np.degrees(greatest(np.angle(np.exp(1j * headings))))
    differences = {
        "center": apart(arrays["boxes/centers"], drive.centers(times_s, actors)),
        "size": meters(greatest(size_m)),
        "heading": f"{turned_deg:.0e}°",
        "`box_velocity`": f"{100 * greatest(off):.1g} %",
        "`num_lidar_pts`": equality(arrays["boxes/points"], _point_counts(drive, times_s, actors)),
    }
    return Row("`nuscenes`", "annotations", len(actors), differences)


def _point_counts(drive: Drive, times_s: Floats, actors: Ints) -> Ints:
    """Count the points on the given actors in the key frames at the given times."""
    sweeps = drive.sweeps
    starts_s = sweeps.begins_ns / 1e9
    stops_s = np.append(starts_s[sweeps.sensor == 0][1:], np.inf)  # of samples
    counts = []
    for time_s, actor in zip(times_s, actors, strict=True):
        sample = np.abs(starts_s[sweeps.sensor == 0] - time_s).argmin()
        in_sample = (starts_s > time_s - 1e-6) & (starts_s < stops_s[sample])
        key_frames = [
            int(np.flatnonzero(in_sample & (sweeps.sensor == sensor))[0])
            for sensor in range(len(sweeps.sensors))
        ]
        number = len(sweeps.objects) + actor
        objects = (drive.points[sweep]["object"] for sweep in key_frames)
        counts.append(sum(np.count_nonzero(column == number) for column in objects))
    return np.array(counts)


def _boxes_of_key_frames(drive: Drive, arrays: Arrays) -> Row:
    """Compare boxes in the frame of the first lidar."""
    rows = arrays["boxes/in_sensor"]
    sweep = rows[:, 0].astype(np.int64)
    pose = drive.sweeps.pose
    expected = drive.centers(drive.sweeps.begins_ns[sweep] / 1e9, rows[:, 1].astype(np.int64))
    rotated = np.einsum("nij,ni->nj", pose.rotations[sweep], expected - pose.positions[sweep])
    differences = {"center (`get_sample_data`)": apart(rows[:, 2:], rotated)}
    return Row("`nuscenes`", "boxes of key frames, in the lidar's axes", len(rows), differences)


def _interpolated_boxes(drive: Drive, arrays: Arrays, actors: Ints) -> Row:
    """Compare boxes of sweeps between two samples that both contain the box."""
    rows = arrays["boxes/between_samples"]
    actor = rows[:, 1].astype(np.int64)
    times_s = arrays["boxes/times_s"]
    numbers = range(len(drive.movers))
    first_s = np.array([times_s[actors == number].min(initial=np.inf) for number in numbers])
    between = (first_s[actor] < rows[:, 0]) & (rows[:, 0] < times_s.max())
    expected = drive.centers(rows[between, 0], actor[between])
    differences = {"center (`get_boxes`)": apart(rows[between, 2:], expected)}
    return Row("`nuscenes`", "boxes between samples", len(expected), differences)


# -- further formats -------------------------------------------------------------------------------


def compare_kitti(drive: Drive, arrays: Arrays) -> Iterator[Row]:
    """Compare times, and points that are transformed to the world by poses and calibration."""
    sweeps = drive.sweeps
    for sensor in range(len(sweeps.sensors)):
        sequence = f"{sensor:02}"
        numbers = np.flatnonzero(sweeps.sensor == sensor).tolist()
        from_camera = np.linalg.inv(arrays[f"{sequence}/camera_from_sensor"])
        to_world = sweeps.pose.matrix(numbers[0]) @ from_camera
        camera = np.concatenate(
            [arrays[f"{sequence}/points/{row}"][:, :3] for row in range(len(numbers))]
        )
        placed = camera @ to_world[:3, :3].T + to_world[:3, 3]
        truth = np.concatenate([drive.in_world(number) for number in numbers])
        late_s = arrays[f"{sequence}/times_s"] - sweeps.begins_ns[numbers] / 1e9
        differences = {
            "position in the world, by poses and `Tr`": apart(placed, truth),
            "times of sweeps": f"{1e6 * greatest(late_s):.1g} µs",
        }
        yield Row(f"`kitti`, sequence {sequence}", "points", len(truth), differences)


def compare_e57(drive: Drive, arrays: Arrays) -> Iterator[Row]:
    """Compare intensities, and points that are transformed to the world by the scans' poses."""
    numbers = [number for number, points in enumerate(drive.points) if len(points)]
    rows = np.concatenate([arrays[f"e57/points/{scan}"] for scan in range(len(numbers))])
    truth = np.concatenate([drive.in_world(number) for number in numbers])
    differences = {
        "position in the world, by poses of scans": apart(rows[:, :3], truth),
        "intensity": equality(rows[:, 3].astype(np.float32), drive.cloud["intensity"]),
    }
    yield Row("`e57`", "points", len(rows), differences)


def compare_las(drive: Drive, arrays: Arrays) -> Iterator[Row]:
    """Compare positions, GPS times and other columns."""
    cloud = drive.cloud
    start_s = (START - _GPS_EPOCH).total_seconds() + _LEAP_S - 1e9
    columns = {"classification": "class", "object": "object", "time": "time", "ring": "channel"}
    for name in ("las", "laz"):
        late_s = arrays[f"{name}/gps_time"] - start_s - cloud["time"] / 1e9
        shares = cloud["intensity"] / compute_full_scale(cloud)
        steps = np.clip(shares, 0, 1) * 65_535.0 - arrays[f"{name}/intensity"]
        first = np.stack([arrays[f"{name}/{field}"].astype(np.int64) for field in columns])
        second = np.stack([cloud[column].astype(np.int64) for column in columns.values()])
        differences = {
            "position": apart(arrays[f"{name}/positions"], cloud.positions),
            "GPS time": f"{1e9 * greatest(late_s):.0f} ns",
            "class, object, time, ring": equality(first, second),
            "intensity": f"{greatest(steps):.2g} of 65,535",
        }
        yield Row(f"`{name}`", "points", len(late_s), differences)


def compare_bag(drive: Drive, arrays: Arrays) -> Iterator[Row]:
    """Compare points at their firing times, the times, and the boxes of actors."""
    sweeps = drive.sweeps
    start_ns = round(START.timestamp()) * 10**9
    parts = []
    for number in range(len(sweeps)):
        topic = f"/{sweeps.sensors[sweeps.sensor[number]]}/points"
        names = arrays[f"bag/fields{topic}"].tolist()
        rows = arrays[f"bag/points{topic}/{start_ns + round(sweeps.begins_ns[number])}"]
        parts.append(rows[:, [names.index(name) for name in ("x", "y", "z", "time", "ring")]])
    rows = np.concatenate(parts)
    starts_ns = np.repeat(sweeps.begins_ns, [len(part) for part in parts])
    late_s = rows[:, 3] - (drive.cloud["time"] - starts_ns) / 1e9
    differences = {
        "position at its firing": apart(rows[:, :3], drive.as_fired),
        "time": f"{1e9 * greatest(late_s):.1f} ns",
        "ring": equality(rows[:, 4], drive.cloud["channel"]),
    }
    yield Row("`mcap`", "points", len(rows), differences)
    boxes = arrays["bag/actors"]
    actors = boxes[:, 1].astype(np.int64)
    times_s = boxes[:, 0] + (arrays["bag/first_ns"].item() - start_ns) / 1e9
    differences = {
        "center": apart(boxes[:, 2:5], drive.centers(times_s, actors)),
        "size": meters(greatest(boxes[:, 5:] - drive.sizes(actors))),
    }
    yield Row("`mcap`", "boxes of `/actors`", len(boxes), differences)
