"""Readers that use third-party programs, for benchmarks/decoders.py.

The script runs in the program's own Python environment, which also needs NumPy. It reads files
with the program and saves what it has read as arrays, whose names begin with the stem of the file.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

Arrays = Iterator[tuple[str, Any]]  # (name, array)


def read_velodyne(path: Path) -> Arrays:
    """Yield the points of a Velodyne .pcap file and their times.

    Points are x, y, z, reflectivity and ring. Times are in seconds.
    """
    import velodyne_decoder

    config = velodyne_decoder.Config(min_range=0.0, max_range=300.0, timestamp_first_packet=True)
    points = []
    times_s = []
    for stamp, scan in velodyne_decoder.read_pcap(str(path), config):
        points.append(scan[:, [0, 1, 2, 3, 6]])
        times_s.append(stamp.device + scan[:, 4].astype(np.float64))
    yield "points", np.concatenate(points)
    yield "times_s", np.concatenate(times_s)


def read_ouster(path: Path) -> Arrays:
    """Yield the points of an Ouster .pcap file, column by column of the range image."""
    from ouster.sdk.core import XYZLut
    from ouster.sdk.pcap import PcapFrameSetSource

    source = PcapFrameSetSource(str(path))
    (info,) = source.sensor_info
    positions_of = XYZLut(info, False)
    names = ("positions", "ranges_mm", "reflectivity", "rows", "times_ns", "frames")
    columns: dict[str, list[Any]] = {name: [] for name in names}
    for number, (frame,) in enumerate(source):
        ranges_mm = frame.field("RANGE")
        column, row = np.nonzero(ranges_mm.T)
        columns["positions"].append(positions_of(ranges_mm)[row, column])
        columns["ranges_mm"].append(ranges_mm[row, column])
        columns["reflectivity"].append(frame.field("REFLECTIVITY")[row, column])
        columns["rows"].append(row)
        columns["times_ns"].append(frame.timestamp[column])
        columns["frames"].append(np.full(len(row), number))
    for name, parts in columns.items():
        yield name, np.concatenate(parts)


def read_nuscenes(path: Path) -> Arrays:
    """Yield the points, classes, boxes and velocities of a data set, read with the devkit."""
    from nuscenes.nuscenes import NuScenes

    gray = defaultdict(lambda: (160, 160, 160))
    tables = NuScenes("v1.0-lidarpool", str(path), verbose=False, colormap=gray)
    yield from _nuscenes_points(tables)
    yield from _annotations(tables)
    yield from _boxes_of_sweeps(tables)
    _check_lists(tables)


def _nuscenes_points(tables: Any) -> Arrays:
    """Yield the points and classes of each sweep, and the first lidar's sweeps merged in fives."""
    from nuscenes.utils.data_classes import LidarPointCloud
    from nuscenes.utils.data_io import load_bin_file

    root = Path(tables.dataroot)
    for sweep in tables.sample_data:
        file = sweep["filename"]
        yield f"points/{file}", LidarPointCloud.from_file(str(root / file)).points.T
    for row in tables.lidarseg:
        file = tables.get("sample_data", row["sample_data_token"])["filename"]
        yield f"classes/{file}", load_bin_file(str(root / row["filename"]), "lidarseg")
    for sample in tables.sample:
        number = number_of(tables.get_sample_data_path(sample["data"]["LIDAR_TOP"]))
        points, _ = LidarPointCloud.from_file_multisweep(
            tables, sample, "LIDAR_TOP", "LIDAR_TOP", nsweeps=5
        )
        yield f"joined/{number}", points.points.T


def _annotations(tables: Any) -> Arrays:
    """Yield the box, velocity and point count of each annotation."""
    columns: dict[str, list[Any]] = defaultdict(list)
    for row in tables.sample_annotation:
        box = tables.get_box(row["token"])
        columns["names"].append(box.name)
        columns["times_s"].append(tables.get("sample", row["sample_token"])["timestamp"] / 1e6)
        columns["centers"].append(box.center)
        columns["sizes"].append(box.wlh[[1, 0, 2]])
        columns["rotations"].append(box.rotation_matrix)
        columns["velocities"].append(tables.box_velocity(row["token"]))
        columns["points"].append(row["num_lidar_pts"])
    for name, values in columns.items():
        yield f"boxes/{name}", np.array(values)


def _boxes_of_sweeps(tables: Any) -> Arrays:
    """Yield boxes of key frames in the sensor frame, and of other sweeps in the world frame.

    Rows contain the sweep's number (key frames) or its time in seconds (other sweeps), the box's
    instance, and its center.
    """

    def instance(box: Any) -> int:
        token = tables.get("sample_annotation", box.token)["instance_token"]
        return int(tables.getind("instance", token))

    in_sensor = []
    for sample in tables.sample:
        file, boxes, _ = tables.get_sample_data(sample["data"]["LIDAR_TOP"])
        in_sensor += [(number_of(file), instance(box), *box.center) for box in boxes]
    yield "boxes/in_sensor", np.array(in_sensor)
    between_samples = [
        (sweep["timestamp"] / 1e6, instance(box), *box.center)
        for sweep in tables.sample_data
        if not sweep["is_key_frame"]
        for box in tables.get_boxes(sweep["token"])
    ]
    yield "boxes/between_samples", np.array(between_samples)


def _check_lists(tables: Any) -> None:
    """Call more devkit functions that need neither images nor the official nuScenes splits."""
    from nuscenes.eval.common.data_classes import EvalBoxes
    from nuscenes.eval.common.loaders import add_center_dist
    from nuscenes.eval.detection.data_classes import DetectionBox

    tables.list_scenes()
    tables.list_categories()
    tables.list_attributes()
    tables.list_lidarseg_categories()
    boxes = EvalBoxes()
    for sample in tables.sample:
        tables.list_sample(sample["token"])
        tables.get_sample_lidarseg_stats(sample["token"])
        center = (0, 0, 0)
        box = DetectionBox(sample["token"], translation=center, detection_name="car")
        boxes.add_boxes(sample["token"], [box])
    add_center_dist(tables, boxes)  # distances from LIDAR_TOP


def number_of(file: str) -> int:
    """Return the number in the name of a sweep file."""
    return int(Path(file).name.partition(".")[0])


def read_kitti(path: Path) -> Arrays:
    """Yield the calibration and times of a sequence, and its points in the first camera's frame."""
    import pykitti

    drive = pykitti.odometry(str(path.parent.parent), path.name)
    yield "times_s", np.array([time.total_seconds() for time in drive.timestamps])
    camera_from_sensor = drive.calib.T_cam0_velo
    yield "camera_from_sensor", camera_from_sensor
    for number, (pose, points) in enumerate(zip(drive.poses, drive.velo, strict=True)):
        homogeneous = np.column_stack([points[:, :3].astype(np.float64), np.ones(len(points))])
        moved = homogeneous @ (pose @ camera_from_sensor).T
        yield f"points/{number}", np.column_stack([moved[:, :3], points[:, 3]])


def read_e57(path: Path) -> Arrays:
    """Yield the intensities and world coordinates of each scan's points."""
    import pye57

    with pye57.E57(str(path)) as file:
        for number in range(file.scan_count):
            scan = file.read_scan(number, intensity=True, ignore_missing_fields=True)
            names = ("cartesianX", "cartesianY", "cartesianZ", "intensity")
            yield f"points/{number}", np.column_stack([scan[name] for name in names])


def read_las(path: Path) -> Arrays:
    """Yield the positions and columns of a .las or .laz file."""
    import laspy

    cloud = laspy.read(path)
    yield "positions", cloud.xyz
    for name in ("gps_time", "intensity", "classification", "object", "time", "ring"):
        yield name, np.array(cloud[name])


def read_bag(path: Path) -> Arrays:
    """Yield the points of each PointCloud2 and the boxes of each MarkerArray."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    actors = []
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            if channel.topic.endswith("/points"):
                yield from _bag_points(channel.topic, message)
            elif channel.topic == "/actors":
                actors += [_bag_box(marker) for marker in message.markers if marker.action == 0]
    # Nanoseconds since 1970 do not fit into float64: they are counted from the first.
    first_ns = min(time_ns for time_ns, _ in actors)
    yield "first_ns", np.array(first_ns)
    yield "actors", np.array([((time_ns - first_ns) / 1e9, *row) for time_ns, row in actors])


def _bag_points(topic: str, message: Any) -> Arrays:
    """Yield a PointCloud2's points as a float64 array (n, fields), and its field names."""
    kinds = {2: "u1", 4: "u2", 5: "<i4", 6: "<u4", 7: "<f4", 8: "<f8"}
    names = [field.name for field in message.fields]
    row = np.dtype(
        {
            "names": names,
            "formats": [kinds[field.datatype] for field in message.fields],
            "offsets": [field.offset for field in message.fields],
            "itemsize": message.point_step,
        }
    )
    points = np.frombuffer(message.data, row)
    columns = [points[name].astype(np.float64) for name in names]
    yield f"points{topic}/{_stamp_ns(message)}", np.column_stack(columns)
    yield f"fields{topic}", np.array(names)


def _bag_box(marker: Any) -> tuple[int, tuple[float, ...]]:
    """Return a marker's timestamp in nanoseconds, its number, its center and its size."""
    center = marker.pose.position
    size = marker.scale
    row = (marker.id, center.x, center.y, center.z, size.x, size.y, size.z)
    return _stamp_ns(marker), row


def _stamp_ns(message: Any) -> int:
    """Return the timestamp in a message header, in nanoseconds since 1970."""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


READERS: dict[str, Callable[[Path], Arrays]] = {
    "velodyne-decoder": read_velodyne,
    "ouster-sdk": read_ouster,
    "nuscenes-devkit": read_nuscenes,
    "pykitti": read_kitti,
    "pye57": read_e57,
    "laspy": read_las,
    "mcap": read_bag,
}


def main(program: str, out: str, *files: str) -> None:
    arrays = {
        f"{Path(file).stem}/{name}": array
        for file in files
        for name, array in READERS[program](Path(file))
    }
    np.savez(out, version=version(program), **arrays)


if __name__ == "__main__":
    main(*sys.argv[1:])
