"""Sweeps a second that data sets are read with: by lidarpool, and by the format's own loader.

    python -m benchmarks.loaders [FORMAT ...]

Both read the same files, which are in memory, in order and in one process. It needs the packages
webdataset, pykitti, nuscenes-devkit and pyarrow; formats without theirs are left out.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

import lidarpool as lp
from lidarpool.base.storage import Storage
from lidarpool.datasets.dataset import DataSet
from lidarpool.datasets.job_table import JobRow, write_table
from lidarpool.export.sweeps import Sweeps
from lidarpool.scene.actors import Actor, box

POINTS, TURNS, JOBS, ROUNDS = 30_000, 20, 6, 7


def webdataset(place: Path) -> Iterator[Any]:
    import webdataset as wds

    shards = sorted(map(str, (place / "shards").rglob("*.tar")))
    yield from wds.WebDataset(shards, shardshuffle=False).decode()


def kitti(place: Path) -> Iterator[Any]:
    import pykitti

    for folder in sorted((place / "sequences").iterdir()):
        drive = pykitti.odometry(str(place), folder.name)
        for number, points in enumerate(drive.velo):
            # It reads no labels: this is what semantic-kitti-api does.
            file = place / "sequences" / folder.name / "labels" / f"{number:06}.label"
            labels = np.fromfile(file, np.uint32)
            yield points, labels & 0xFFFF, labels >> 16, drive.poses[number]


def nuscenes(place: Path) -> Iterator[Any]:
    from nuscenes.nuscenes import NuScenes
    from nuscenes.utils.data_classes import LidarPointCloud

    tables = NuScenes("v1.0-lidarpool", str(place), verbose=False)
    for row in tables.sample_data:
        path, boxes, _ = tables.get_sample_data(row["token"])
        yield LidarPointCloud.from_file(path), boxes


def parquet(place: Path) -> Iterator[Any]:
    import pyarrow.dataset

    for folder in (place / "points").iterdir():
        table = pyarrow.dataset.dataset(folder, format="parquet")
        scans = np.load(place / f"sweeps/{int(folder.name[4:]):04}.npz")["scans"]
        field = pyarrow.dataset.field("scan")
        for first, stop in pairwise(scans):
            rows = table.to_table(filter=(field >= first) & (field < stop), use_threads=False)
            yield {name: rows[name].to_numpy() for name in rows.column_names}


PEERS: dict[str, tuple[str, Callable[[Path], Iterator[Any]]]] = {
    "webdataset": ("webdataset", webdataset), "kitti": ("pykitti", kitti),
    "nuscenes": ("nuscenes", nuscenes), "parquet": ("pyarrow", parquet),
}  # fmt: skip


def write(place: Path, name: str) -> None:
    """Write a data set of sweeps of 30,000 points past a car."""
    lidar = lp.Sensor.grid(360, 4)
    track = lp.Track([0, 60], [[0, 0, 1], [60, 5, 1]])
    car = Actor(box("Car 1", (4, 2, 1.5)), lp.Track([0, 60], [[5, 5, 0], [9, 5, 0]]))
    scans, scene = TURNS * 36, lp.Scene.seed()
    survey = lp.Survey(lidar, trajectory=track, steps=scans)
    sweeps = Sweeps.of(survey, scene.with_actors((car,)))
    rng, count, data = np.random.default_rng(1), TURNS * POINTS, DataSet(Storage.at(place), name)
    scan = np.arange(count) * scans // count
    columns = {
        "scan": scan, "ray": np.arange(count) % 40, "channel": np.arange(count) % 4,
        "object": rng.integers(0, len(scene.names) + 1, count), "class": rng.integers(0, 30, count),
        "intensity": rng.uniform(0, 1, count).astype(np.float32), "time": scan * 1000,
    }  # fmt: skip
    cloud = lp.Cloud(np.round(rng.uniform(-60, 60, (count, 3)), 3), columns)
    rows = [data.write_job(JobRow(n, f"{n:04}"), cloud, sweeps) for n in range(JOBS)]
    data.finish(rows)
    write_table(data.place, [], lambda: rows)


def rates(*reads: Callable[[], Iterator[Any]]) -> list[float]:
    """Sweeps a second of each, of its fastest of some rounds."""
    best = [0.0] * len(reads)
    for _ in range(ROUNDS):
        for number, read in enumerate(reads):  # in turn: a busy machine slows down all
            begin = time.perf_counter()
            count = sum(1 for _ in read())
            best[number] = max(best[number], count / (time.perf_counter() - begin))
    return best


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("formats", nargs="*", default=[*PEERS])
    for name in parser.parse_args().formats:
        package, peer = PEERS[name]
        if find_spec(package) is None:
            continue
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder)
            write(place, name)
            own, other = rates(lp.sweeps(place).__iter__, partial(peer, place))
        print(f"{name:>10}  {own:6.0f}/s  {package:>10} {other:6.0f}/s  {own / other:.2f}")


if __name__ == "__main__":
    main()
