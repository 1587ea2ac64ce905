"""Compare the rate of `lidarpool.sweeps` with the usual loader of each format.

    python -m benchmarks.loaders [FORMAT ...]

In each round, both loaders open the same data set again in one process and read all sweeps in
order. Files are cached in memory. For each sweep, `lidarpool.sweeps` provides points, all columns
of the format, the pose, and boxes if the other loader provides them. The other loaders provide

- webdataset: the whole sample with points, columns, pose and boxes as arrays, and parsed JSON;
- pykitti: points with intensities and poses; NumPy reads labels as semantic-kitti-api does, and
  separates classes from objects;
- nuscenes-devkit: points with intensities, without the channel, and the boxes of actors;
- pyarrow: all columns with positions in world coordinates.

Formats are skipped if their package is not installed.
"""

import tempfile
from functools import partial
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

import numpy as np

import lidarpool as lp

from .harness import argument_parser, median_ratio, run_rounds, time_call, write_results

POINTS = 30_000
REVOLUTIONS = 20
JOBS = 6


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


def write_data_set(folder, name, cloud, sweeps):
    """Write a data set of jobs that have the same sweeps, like a campaign."""
    from lidarfiles.datasets.dataset import DataSet  # other versions may not have these modules
    from lidarfiles.datasets.job_table import JobRow, write_table
    from lidarsim.io.storage import Storage

    data = DataSet(Storage.at(folder), name)
    jobs = [data.write_job(JobRow(n, f"{n:04}"), cloud, sweeps) for n in range(JOBS)]
    write_table(data.storage, [], lambda: jobs)
    data.finish(jobs)


def write(folder, name):
    """Write a data set of sweeps of a sensor that passes a car."""
    from lidarsim.sweeps.sweeps import Sweeps

    track = lp.Track([0, 60], [[0, 0, 1], [60, 5, 1]])
    scans = REVOLUTIONS * 36
    car = lp.Actor(lp.box("Car 1", (4, 2, 1.5)), lp.Track([0, 60], [[5, 5, 0], [9, 5, 0]]))
    scene = lp.Scene.seed().with_actors((car,))
    survey = lp.Survey(lp.Sensor.grid(360, 4), trajectory=track, steps=scans)
    sweeps = Sweeps.from_survey(survey, scene)
    rng = np.random.default_rng(1)
    count = REVOLUTIONS * POINTS
    rows = np.arange(count)
    columns = {"scan": np.arange(count) * scans // count}
    columns |= {"ray": rows % 40, "channel": rows % 4, "class": rng.integers(0, 30, count)}
    columns |= {"object": rng.integers(0, len(scene.object_names), count)}
    columns |= {"intensity": rng.random(count, np.float32), "time": columns["scan"] * 1000}
    columns["reflectivity"] = rng.integers(0, 256, count).astype(np.uint8)
    cloud = lp.Cloud(np.round(rng.uniform(-60, 60, (count, 3)), 3), columns)
    write_data_set(folder, name, cloud, sweeps)


def main(arguments=None):
    """Measure all formats and print a row for each."""
    parser = argument_parser(__doc__, repeat=15)
    known = [peer.__name__ for peer in PEERS]
    parser.add_argument("formats", metavar="FORMAT", nargs="*", help=f"of {', '.join(known)}")
    options = parser.parse_args(arguments)
    if unknown := {*options.formats} - {*known}:
        parser.error(f"Unknown format {', '.join(unknown)}")
    results = {}
    for peer, package in PEERS.items():
        name = peer.__name__
        if (options.formats and name not in options.formats) or find_spec(package) is None:
            continue
        with tempfile.TemporaryDirectory() as folder:
            write(data_folder := Path(folder), name)
            reads = {
                "lidarpool": partial(lidarpool, data_folder, peer in WITH_BOXES),
                package: partial(peer, data_folder),
            }
            calls = {key: lambda _, read=read: sweep_rate(read) for key, read in reads.items()}
            rates = results[name] = run_rounds(calls, options.repeat, warm_up=0)
        ratio = median_ratio(rates["lidarpool"], rates[package])
        words = " ".join(f"{key:>11} {max(values):6.0f}/s" for key, values in rates.items())
        print(f"{name:>10} {words} {ratio:6.2f}")
    write_results(options.json, results)


def sweep_rate(read):
    """Return the number of sweeps read per second of CPU time."""
    seconds, count = time_call(lambda: sum(1 for _ in read()))
    return count / seconds


if __name__ == "__main__":
    main()
