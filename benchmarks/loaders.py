"""Sweeps a second of processor time: by lidarpool, and by the own loader of each format.

    python -m benchmarks.loaders [FORMAT ...]

Both read the same files in order. Formats whose package is not installed are left out.
"""

import sys
import tempfile
import time
from functools import partial
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

import numpy as np

import lidarpool as lp
from lidarpool.base.storage import Storage
from lidarpool.datasets.dataset import DataSet
from lidarpool.datasets.job_table import JobRow, write_table
from lidarpool.export.sweeps import Sweeps
from lidarpool.scene.actors import Actor, box

POINTS, TURNS, JOBS, ROUNDS = 30_000, 20, 6, 7


def webdataset(place):
    import webdataset as wds

    yield from wds.WebDataset([*map(str, place.rglob("*.tar"))], shardshuffle=False).decode()


def kitti(place):
    import pykitti

    for folder in (place / "sequences").iterdir():
        drive = pykitti.odometry(str(place), folder.name)
        for number, points in enumerate(drive.velo):  # the labels as semantic-kitti-api reads them
            labels = np.fromfile(folder / f"labels/{number:06}.label", np.uint32)
            yield points, labels & 0xFFFF, labels >> 16, drive.poses[number]


def nuscenes(place):
    from nuscenes.nuscenes import NuScenes
    from nuscenes.utils.data_classes import LidarPointCloud

    tables = NuScenes("v1.0-lidarpool", str(place), verbose=False)
    for row in tables.sample_data:
        path, boxes, _ = tables.get_sample_data(row["token"])
        yield LidarPointCloud.from_file(path), boxes


def parquet(place):
    import pyarrow.dataset

    for folder in (place / "points").iterdir():
        table, scan = pyarrow.dataset.dataset(folder), pyarrow.dataset.field("scan")
        scans = np.load(place / f"sweeps/{int(folder.name[4:]):04}.npz")["scans"]
        for first, stop in pairwise(scans):
            rows = table.to_table(filter=(scan >= first) & (scan < stop), use_threads=False)
            yield {name: rows[name].to_numpy() for name in rows.column_names}


PEERS = {webdataset: "webdataset", kitti: "pykitti", nuscenes: "nuscenes", parquet: "pyarrow"}


def write(place, name):
    """Write a data set of sweeps past a car."""
    track, scans = lp.Track([0, 60], [[0, 0, 1], [60, 5, 1]]), TURNS * 36
    car = Actor(box("Car 1", (4, 2, 1.5)), lp.Track([0, 60], [[5, 5, 0], [9, 5, 0]]))
    scene = lp.Scene.seed().with_actors((car,))
    sweeps = Sweeps.of(lp.Survey(lp.Sensor.grid(360, 4), trajectory=track, steps=scans), scene)
    rng, count, data = np.random.default_rng(1), TURNS * POINTS, DataSet(Storage.at(place), name)
    rows, columns = np.arange(count), {"scan": np.arange(count) * scans // count}
    columns |= {"ray": rows % 40, "channel": rows % 4, "class": rng.integers(0, 30, count)}
    columns |= {"object": rng.integers(0, len(scene.all_names), count)}
    columns |= {"intensity": rng.random(count, np.float32), "time": columns["scan"] * 1000}
    cloud = lp.Cloud(np.round(rng.uniform(-60, 60, (count, 3)), 3), columns)
    jobs = [data.write_job(JobRow(n, f"{n:04}"), cloud, sweeps) for n in range(JOBS)]
    data.finish(jobs)
    write_table(data.place, [], lambda: jobs)


def main(*names):
    for peer, package in PEERS.items():
        if (names and peer.__name__ not in names) or find_spec(package) is None:
            continue
        with tempfile.TemporaryDirectory() as folder:
            write(place := Path(folder), peer.__name__)
            reads, best = (lp.sweeps(place).__iter__, partial(peer, place)), [0.0, 0.0]
            for turn in range(2 * ROUNDS):  # of both in turn: a busy machine slows down both
                begin = time.process_time()
                rate = sum(1 for _ in reads[turn % 2]()) / (time.process_time() - begin)
                best[turn % 2] = max(best[turn % 2], rate)
        print(f"{peer.__name__:>10} {best[0]:6.0f}/s {package:>11} {best[1]:6.0f}/s")


if __name__ == "__main__":
    main(*sys.argv[1:])
