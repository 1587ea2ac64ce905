"""How fast clouds are exported: each format beside a short script with the same library.

    python -m benchmarks.formats [POINTS]

Prints millions of points a second of processor time, and the most memory in MB without pages of
the mapped cloud. The scripts write neither poses nor labels, and read the whole cloud at once.
"""

import multiprocessing
import sys
import tempfile
import threading
import time
from pathlib import Path

import laspy
import numpy as np
import pyarrow as pa
import pye57
from pyarrow.parquet import write_table
from pypcd4.pypcd4 import Encoding, PointCloud
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from lidarpool import Cloud, Scene, Sensor, Survey, Track, save_cloud
from lidarpool.export.formats import Format
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.columns.ply_format import layout
from lidarsim.sweeps.sweeps import Sweeps

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
TURNS = 100


def make(folder, points):
    """Write a cloud of so many points in 100 sweeps of a sensor that moves, and the sweeps."""
    track = Track([0, 100], [[0, 0, 1], [300, 50, 1]])
    survey = Survey(Sensor.grid(360, 4), trajectory=track, steps=36 * TURNS, columns=COLUMNS)
    Sweeps.from_survey(survey, Scene.seed()).save(folder / "sweeps.npz")
    rng = np.random.default_rng(1)
    scan = np.arange(points) * (36 * TURNS) // points
    around = np.arange(points) * 1e-3
    places = np.stack([50 * np.cos(around), 50 * np.sin(around), rng.uniform(0, 5, points)], 1)
    columns = {"scan": scan, "channel": rng.integers(0, 64, points), "object": scan // 9 % 7}
    columns |= {"time": scan * 2_777_777, "class": scan // 9 % 5}
    columns |= {"reflectivity": rng.integers(0, 256, points).astype(np.uint8)}
    columns |= {name: rng.random(points, np.float32) for name in COLUMNS[3:]}
    save_cloud(Cloud(np.round(places, 3), columns), folder / "cloud.ply")


def export(name, folder, out):
    """Export as `lidarpool export` does."""
    cloud = CloudFile(folder / "cloud.ply")
    sweeps = Sweeps.load(folder / "sweeps.npz")
    Format(name).write(out, cloud, sweeps)


def las(rows, out):
    header = laspy.LasHeader(version="1.4", point_format=6)
    names = rows.dtype.names[3:]
    header.scales = np.full(3, 0.001)
    more = [name for name in names if name != "intensity"]
    header.add_extra_dims([laspy.ExtraBytesParams(name, rows.dtype[name]) for name in more])
    data = laspy.LasData(header)
    data.xyz = np.stack([rows[axis] for axis in "xyz"], axis=1)
    data.intensity = rows["intensity"] * 65_535
    data.gps_time = rows["time"] / 1e9
    for name in more:
        data[name] = rows[name]
    data.write(out, do_compress=out.suffix == ".laz")


def parquet(rows, out):
    write_table(pa.table({n: np.ascontiguousarray(rows[n]) for n in rows.dtype.names}), out)


def e57(rows, out):
    with pye57.E57(str(out), mode="w") as file:
        for turn in np.array_split(rows, TURNS):
            data = {f"cartesian{axis.upper()}": turn[axis].astype(float) for axis in "xyz"}
            file.write_scan_raw(data | {"intensity": turn["intensity"].copy()})


def mcap(rows, out):
    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/PointCloud2"
    stamp = store.types["builtin_interfaces/msg/Time"](0, 0)
    header = store.types["std_msgs/msg/Header"](stamp, "lidar")
    point = np.dtype([(n, "f4") for n in ("x", "y", "z", "intensity", "time")] + [("ring", "u2")])
    with Writer(out, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topic = bag.add_connection("/points", kind, typestore=store)
        for number, turn in enumerate(np.array_split(rows, TURNS)):
            packed = turn[list(point.names)].astype(point).view("u1")
            size = len(turn)
            message = store.types[kind](header, 1, size, [], False, 22, 22 * size, packed, True)
            bag.write(topic, number, store.serialize_cdr(message, kind))


def pcd(rows, out):
    out.mkdir()
    for number, turn in enumerate(np.array_split(rows, TURNS)):
        arrays = [turn[n].astype("f8" if n == "time" else turn.dtype[n]) for n in turn.dtype.names]
        file = PointCloud.from_points(arrays, turn.dtype.names, [array.dtype for array in arrays])
        file.save(out / f"{number}.pcd", Encoding.BINARY)


def kitti(rows, out):
    out.mkdir()
    for number, turn in enumerate(np.array_split(rows, TURNS)):
        columns = [turn[name] for name in ("x", "y", "z", "intensity")]
        np.column_stack(columns).astype("f4").tofile(out / f"{number}.bin")


SCRIPTS = {
    "las": las, "laz": las, "parquet": parquet, "pcd": pcd, "e57": e57, "kitti": kitti,
    "mcap": mcap,
}  # fmt: skip


def script(name, folder, out):
    """Write the same points by the library alone."""
    start, count, row = layout(folder / "cloud.ply")
    SCRIPTS[name](np.fromfile(folder / "cloud.ply", row, count, offset=start), out)


def measured(write, *given):
    """Processor seconds of a call in this process, and the most memory in MB."""
    most = [0]
    done = threading.Event()

    def watch():
        while not done.wait(0.02):
            status = Path("/proc/self/status").read_text()
            most.append(int(status.split("RssAnon:")[1].split()[0]))

    threading.Thread(target=watch).start()
    begin = time.process_time()
    write(*given)
    done.set()
    return time.process_time() - begin, max(most) / 1000


def main(points=10_000_000):
    """Print the table."""
    fresh = multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1)
    with fresh, tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        fresh.apply(make, (folder, points))
        print(f"{'format':10}{'Mpt/s':>8}{'script':>8}{'ratio':>7}{'MB':>8}{'script':>8}")
        for name in SCRIPTS:
            (ours, held), (its, its_held) = (
                fresh.apply(measured, (write, name, folder, folder / f"{write.__name__}.{name}"))
                for write in (export, script)
            )
            rates = f"{points / ours / 1e6:8.2f}{points / its / 1e6:8.2f}{ours / its:7.2f}"
            print(f"{name:10}{rates}{held:8.0f}{its_held:8.0f}", flush=True)


if __name__ == "__main__":
    main(*(int(float(number)) for number in sys.argv[1:]))
