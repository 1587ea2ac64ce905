"""Sweeps a second of processor time: by lidarpool, and by the own loader of each format.

    python -m benchmarks.loaders [FORMAT ...]

Both open the same data set anew in each round, in one process, and read all sweeps in order; files
are in memory. `lidarpool.sweeps` gives points, all columns that the format holds and the pose of
each sweep, and boxes where the other gives them. The others give, for each sweep,

- webdataset all of a sample: points, columns, pose and boxes as arrays, `json` parsed;
- pykitti points with intensities and poses; beside it, NumPy reads labels as semantic-kitti-api
  does, and parts classes from objects;
- nuscenes-devkit points with intensities (the channel is cut off) and the boxes of actors;
- pyarrow all columns with positions, in the axes of the world.

The ratio is the median of the ratios of all rounds. Formats whose package is not installed are left
out.
"""

import argparse
import tempfile
import time
from functools import partial
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

import numpy as np

import lidarpool as lp
from lidarpool.datasets.dataset import DataSet
from lidarpool.datasets.job_table import JobRow, write_table
from lidarsim.io.storage import Storage
from lidarsim.scene.actors import Actor, box
from lidarsim.sweeps.sweeps import Sweeps

POINTS = 30_000
REVOLUTIONS = 20
JOBS = 6
ROUNDS = 15


def webdataset(folder):
    import webdataset as wds

    yield from wds.WebDataset([*map(str, folder.rglob("*.tar"))], shardshuffle=False).decode()


def kitti(root):
    import pykitti

    for folder in (root / "sequences").iterdir():
        drive = pykitti.odometry(str(root), folder.name)
        for number, points in enumerate(drive.velo):  # the labels as semantic-kitti-api reads them
            labels = np.fromfile(folder / f"labels/{number:06}.label", np.uint32)
            yield points, labels & 0xFFFF, labels >> 16, drive.poses[number]


def nuscenes(folder):
    from nuscenes.nuscenes import NuScenes
    from nuscenes.utils.data_classes import LidarPointCloud

    tables = NuScenes("v1.0-lidarpool", str(folder), verbose=False)
    for row in tables.sample_data:
        path, boxes, _ = tables.get_sample_data(row["token"])
        yield LidarPointCloud.from_file(path), boxes


def parquet(root):
    import pyarrow.dataset

    for folder in (root / "points").iterdir():
        table = pyarrow.dataset.dataset(folder)
        scan = pyarrow.dataset.field("scan")
        scans = np.load(root / f"sweeps/{int(folder.name[4:]):04}.npz")["scans"]
        for first, stop in pairwise(scans):
            rows = table.to_table(filter=(scan >= first) & (scan < stop), use_threads=False)
            yield {name: rows[name].to_numpy() for name in rows.column_names}


def lidarpool(folder, with_boxes):
    for sweep in lp.sweeps(folder):
        yield sweep.points, sweep.columns, sweep.pose, with_boxes and sweep.boxes


WITH_BOXES = webdataset, nuscenes
PEERS = {webdataset: "webdataset", kitti: "pykitti", nuscenes: "nuscenes", parquet: "pyarrow"}


def write(folder, name):
    """Write a data set of sweeps past a car."""
    track = lp.Track([0, 60], [[0, 0, 1], [60, 5, 1]])
    scans = REVOLUTIONS * 36
    car = Actor(box("Car 1", (4, 2, 1.5)), lp.Track([0, 60], [[5, 5, 0], [9, 5, 0]]))
    scene = lp.Scene.seed().with_actors((car,))
    survey = lp.Survey(lp.Sensor.grid(360, 4), trajectory=track, steps=scans)
    sweeps = Sweeps.from_survey(survey, scene)
    rng = np.random.default_rng(1)
    count = REVOLUTIONS * POINTS
    data = DataSet(Storage.at(folder), name)
    rows = np.arange(count)
    columns = {"scan": np.arange(count) * scans // count}
    columns |= {"ray": rows % 40, "channel": rows % 4, "class": rng.integers(0, 30, count)}
    columns |= {"object": rng.integers(0, len(scene.object_names), count)}
    columns |= {"intensity": rng.random(count, np.float32), "time": columns["scan"] * 1000}
    columns["reflectivity"] = rng.integers(0, 256, count).astype(np.uint8)
    cloud = lp.Cloud(np.round(rng.uniform(-60, 60, (count, 3)), 3), columns)
    jobs = [data.write_job(JobRow(n, f"{n:04}"), cloud, sweeps) for n in range(JOBS)]
    write_table(data.storage, [], lambda: jobs)
    data.finish(jobs)


def main(*names):
    for peer, package in PEERS.items():
        if (names and peer.__name__ not in names) or find_spec(package) is None:
            continue
        with tempfile.TemporaryDirectory() as folder:
            write(data_folder := Path(folder), peer.__name__)
            reads = partial(lidarpool, data_folder, peer in WITH_BOXES), partial(peer, data_folder)
            rates = np.empty((ROUNDS, 2))
            for index in np.ndindex(rates.shape):  # in turns: a busy machine slows down both
                begin = time.process_time()
                count = sum(1 for _ in reads[index[1]]())
                rates[index] = count / (time.process_time() - begin)
        lidarpool_rate, peer_rate = rates.max(axis=0)
        ratio = np.median(rates[:, 0] / rates[:, 1])
        print(
            f"{peer.__name__:>10} {lidarpool_rate:6.0f}/s "
            f"{package:>11} {peer_rate:6.0f}/s {ratio:6.2f}"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("formats", metavar="FORMAT", nargs="*", help="by default all formats")
    chosen = parser.parse_args().formats
    if unknown := {*chosen} - {peer.__name__ for peer in PEERS}:
        parser.error(f"no loader of {', '.join(unknown)}")
    main(*chosen)
