"""Compare the rate of each export with a minimal script that uses the same library.

    python -m benchmarks.formats [--points 1e7]

The table lists millions of points per second of CPU time, and the peak memory in MB without the
pages of the mapped cloud. The scripts write neither poses nor labels, and read the whole cloud at
once.
"""

import multiprocessing
import tempfile
import threading
from pathlib import Path

import laspy
import numpy as np
import pyarrow as pa
import pye57
from pyarrow.parquet import write_table
from pypcd4.pypcd4 import Encoding, PointCloud
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from lidarfiles.clouds.writing import ExportSpec
from lidarpool import Cloud, Scene, Sensor, Survey, Track, save_cloud
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.columns.ply_format import layout
from lidarsim.sweeps.sweeps import Sweeps

from .harness import argument_parser, time_call, write_results

COLUMNS = (
    "time",
    "class",
    "reflectivity",
    "intensity",
    "reflectance",
    "range",
    "azimuth",
    "elevation",
)
REVOLUTIONS = 100


def write_inputs(folder, points):
    """Write a cloud of `points` points and 100 sweeps of a moving sensor."""
    track = Track([0, 100], [[0, 0, 1], [300, 50, 1]])
    survey = Survey(Sensor.grid(360, 4), trajectory=track, steps=36 * REVOLUTIONS, columns=COLUMNS)
    Sweeps.from_survey(survey, Scene.seed()).save(folder / "sweeps.npz")
    rng = np.random.default_rng(1)
    scan = np.arange(points) * (36 * REVOLUTIONS) // points
    angle = np.arange(points) * 1e-3
    positions = np.stack([50 * np.cos(angle), 50 * np.sin(angle), rng.uniform(0, 5, points)], 1)
    columns = {"scan": scan, "channel": rng.integers(0, 64, points), "object": scan // 9 % 7}
    columns |= {"time": scan * 2_777_777, "class": scan // 9 % 5}
    columns |= {"reflectivity": rng.integers(0, 256, points).astype(np.uint8)}
    columns |= {name: rng.random(points, np.float32) for name in COLUMNS[3:]}
    save_cloud(Cloud(np.round(positions, 3), columns), folder / "cloud.ply")


def export(name, folder, path):
    """Export a cloud in the same way as `lidarpool export`."""
    cloud = CloudFile(folder / "cloud.ply")
    sweeps = Sweeps.load(folder / "sweeps.npz")
    ExportSpec(name).write(path, cloud, sweeps)


def las(rows, path):
    header = laspy.LasHeader(version="1.4", point_format=6)
    names = rows.dtype.names[3:]
    header.scales = np.full(3, 0.001)
    extra_names = [name for name in names if name != "intensity"]
    header.add_extra_dims([laspy.ExtraBytesParams(name, rows.dtype[name]) for name in extra_names])
    data = laspy.LasData(header)
    data.xyz = np.stack([rows[axis] for axis in "xyz"], axis=1)
    data.intensity = rows["intensity"] * 65_535
    data.gps_time = rows["time"] / 1e9
    for name in extra_names:
        data[name] = rows[name]
    data.write(path, do_compress=path.suffix == ".laz")


def parquet(rows, path):
    write_table(pa.table({n: np.ascontiguousarray(rows[n]) for n in rows.dtype.names}), path)


def e57(rows, path):
    with pye57.E57(str(path), mode="w") as file:
        for sweep in np.array_split(rows, REVOLUTIONS):
            data = {f"cartesian{axis.upper()}": sweep[axis].astype(float) for axis in "xyz"}
            file.write_scan_raw(data | {"intensity": sweep["intensity"].copy()})


def mcap(rows, path):
    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/PointCloud2"
    stamp = store.types["builtin_interfaces/msg/Time"](0, 0)
    header = store.types["std_msgs/msg/Header"](stamp, "lidar")
    point = np.dtype([(n, "f4") for n in ("x", "y", "z", "intensity", "time")] + [("ring", "u2")])
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topic = bag.add_connection("/points", kind, typestore=store)
        for number, sweep in enumerate(np.array_split(rows, REVOLUTIONS)):
            packed = sweep[list(point.names)].astype(point).view("u1")
            size = len(sweep)
            message = store.types[kind](header, 1, size, [], False, 22, 22 * size, packed, True)
            bag.write(topic, number, store.serialize_cdr(message, kind))


def pcd(rows, folder):
    folder.mkdir()
    for number, sweep in enumerate(np.array_split(rows, REVOLUTIONS)):
        arrays = [
            sweep[n].astype("f8" if n == "time" else sweep.dtype[n]) for n in sweep.dtype.names
        ]
        file = PointCloud.from_points(arrays, sweep.dtype.names, [array.dtype for array in arrays])
        file.save(folder / f"{number}.pcd", Encoding.BINARY)


def kitti(rows, folder):
    folder.mkdir()
    for number, sweep in enumerate(np.array_split(rows, REVOLUTIONS)):
        columns = [sweep[name] for name in ("x", "y", "z", "intensity")]
        np.column_stack(columns).astype("f4").tofile(folder / f"{number}.bin")


SCRIPTS = {
    "las": las, "laz": las, "parquet": parquet, "pcd": pcd, "e57": e57, "kitti": kitti,
    "mcap": mcap,
}  # fmt: skip


def write_by_library(name, folder, path):
    """Write the same points using only the library of the format."""
    start, count, row = layout(folder / "cloud.ply")
    SCRIPTS[name](np.fromfile(folder / "cloud.ply", row, count, offset=start), path)


def measure_call(write, *arguments):
    """Return the CPU time of a call in seconds, and this process's peak memory in MB."""
    samples_kb = [0]
    finished = threading.Event()

    def watch():
        while not finished.wait(0.02):
            status = Path("/proc/self/status").read_text()
            samples_kb.append(int(status.split("RssAnon:")[1].split()[0]))

    threading.Thread(target=watch).start()
    seconds, _ = time_call(lambda: write(*arguments))
    finished.set()
    return seconds, max(samples_kb) / 1000


def main(arguments=None):
    parser = argument_parser(__doc__)
    parser.add_argument("--points", type=float, default=1e7, help="number of points")
    options = parser.parse_args(arguments)
    points = int(options.points)
    results = {}
    processes = multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1)
    with processes, tempfile.TemporaryDirectory() as folder_name:
        folder = Path(folder_name)
        processes.apply(write_inputs, (folder, points))
        print(f"{'format':10}{'Mpt/s':>8}{'script':>8}{'ratio':>7}{'MB':>8}{'script':>8}")
        for name in SCRIPTS:
            (export_s, export_mb), (script_s, script_mb) = results[name] = [
                processes.apply(
                    measure_call, (write, name, folder, folder / f"{write.__name__}.{name}")
                )
                for write in (export, write_by_library)
            ]
            rates = f"{points / export_s / 1e6:8.2f}{points / script_s / 1e6:8.2f}"
            ratio = export_s / script_s
            print(f"{name:10}{rates}{ratio:7.2f}{export_mb:8.0f}{script_mb:8.0f}", flush=True)
    write_results(options.json, results)


if __name__ == "__main__":
    main()
