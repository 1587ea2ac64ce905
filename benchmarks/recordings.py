"""Measure the time to read and view recordings, optionally compared with another checkout.

    python -m benchmarks.recordings [--against CHECKOUT] [--folder FOLDER]

The inputs are written once. They are an airborne survey (.las), the drive of a rotating sensor
(.mcap), a sequence in KITTI format, and a data set of a campaign. Each measurement runs in a new
process, which first performs the action on a small input, so that imports and compilation are not
measured. Short actions are then repeated, and the minimum counts. Processes of the two checkouts
alternate. The ratio is less than 1 if this checkout is faster. Times are CPU times.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import laspy
import numpy as np

import lidarpool as lp

from .harness import argument_parser, median_ratio, run_rounds, time_call, write_results
from .loaders import write_data_set

ROOT = Path(__file__).resolve().parent.parent
SURVEY_POINTS, SCENE_POINTS = 16_000_000, 2_000_000
FIRINGS, CHANNELS, SCANS = 640, 32, 32  # firings and scans per revolution
DRIVE_SWEEPS, JOB_SWEEPS = 500, 50
KITTI_SWEEPS, KITTI_POINTS = 100, 100_000  # points per sweep
SMALL = 0.02  # share of the points, or sweeps, in the inputs that are read before the measurement
LEAST_S = 2  # actions are repeated for so long in each process


def write_survey(path, count):
    """Write points in lines across the flight path, with colors and classes that include noise."""
    rng = np.random.default_rng(1)
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales, header.offsets = np.full(3, 0.001), np.array([4e5, 5.6e6, 0])
    with laspy.open(path, "w", header=header) as writer:
        for rows in np.array_split(np.arange(count), max(1, count // 1_000_000)):
            record = laspy.ScaleAwarePointRecord.zeros(len(rows), header=header)
            line, place = np.divmod(rows, 1000)
            record.X = place * 400 + rng.integers(-100, 100, len(rows))
            record.Y = line * 400 + rng.integers(-100, 100, len(rows))
            record.Z = 5000 * np.sin(line / 200) + rng.integers(0, 20_000, len(rows))
            is_noise = rng.random(len(rows)) < 1e-4
            record.classification = np.where(is_noise, 7, rng.integers(1, 7, len(rows)))
            record.return_number = record.number_of_returns = np.ones(len(rows), np.uint8)
            record.gps_time = rows / 500_000
            for name in ("intensity", "red", "green", "blue"):
                record[name] = rng.integers(0, 65_536, len(rows))
            writer.write_points(record)


def make_drive(sweep_count):
    """Return the points and sweeps of a sensor that moves past a car."""
    from lidarsim.sweeps.sweeps import Sweeps  # other versions may not have this module

    rng = np.random.default_rng(1)
    times_s, x_m = [0, sweep_count / 10], 0.8 * sweep_count
    car = lp.Actor(lp.box("Car 1", (4, 2, 1.5)), lp.Track(times_s, [[5, 5, 0], [5 + x_m, 5, 0]]))
    scene = lp.Scene.seed().with_actors((car,))
    track = lp.Track(times_s, [[0, 0, 2], [x_m, 0, 2]])
    sensor = lp.Sensor.grid(FIRINGS, CHANNELS, 40, 360 / SCANS)
    survey = lp.Survey(sensor, trajectory=track, steps=SCANS * sweep_count)
    rows = np.arange(sweep_count * FIRINGS * CHANNELS)
    firing, channel = np.divmod(rows, CHANNELS)
    azimuth, slope = 2 * np.pi / FIRINGS * firing, np.linspace(-0.36, 0.36, CHANNELS)[channel]
    positions = np.stack([np.cos(azimuth), np.sin(azimuth), slope], axis=1)
    positions = positions * rng.uniform(2, 80, (len(rows), 1)) + [0, 0, 2]
    positions[:, 0] += 0.8 / FIRINGS * firing
    columns = {
        "scan": firing * SCANS // FIRINGS,
        "ray": rows % (FIRINGS * CHANNELS // SCANS),
        "channel": channel,
        "object": rng.integers(0, len(scene.object_names), len(rows)),
        "class": rng.integers(1, 20, len(rows)),
        "time": firing * 100_000_000 // FIRINGS,
        "intensity": rng.random(len(rows), np.float32),
        "reflectivity": rng.integers(0, 256, len(rows)).astype(np.uint8),
    }
    return lp.Cloud(np.round(positions, 3), columns), Sweeps.from_survey(survey, scene)


def write_kitti(folder, sweep_count):
    """Write a sequence in SemanticKITTI format."""
    rng = np.random.default_rng(1)
    (folder / "velodyne").mkdir(parents=True)
    (folder / "labels").mkdir()
    rows = rng.uniform(-60, 60, (KITTI_POINTS, 4)).astype("<f4")
    labels = rng.integers(0, 50, KITTI_POINTS) << 16 | rng.integers(0, 20, KITTI_POINTS)
    for number in range(sweep_count):
        rows[:, 3] = rng.random(KITTI_POINTS)
        rows.tofile(folder / "velodyne" / f"{number:06}.bin")
        labels.astype("<u4").tofile(folder / "labels" / f"{number:06}.label")
    poses = [[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, number] for number in range(sweep_count)]
    np.savetxt(folder / "poses.txt", poses)
    np.savetxt(folder / "times.txt", np.arange(sweep_count) / 10)
    (folder / "calib.txt").write_text("Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n", encoding="ascii")


def write_inputs(folder, share=1.0):
    """Write all inputs with a fraction of the points or sweeps, unless they exist."""
    from lidarfiles.clouds.writing import ExportSpec

    if folder.exists():
        return
    staged = folder.with_name(f"{folder.name}.incomplete")
    shutil.rmtree(staged, ignore_errors=True)
    staged.mkdir(parents=True)
    write_survey(staged / "survey.las", int(share * SURVEY_POINTS))
    write_survey(staged / "scene.las", int(share * SCENE_POINTS))
    ExportSpec("mcap").write(staged / "drive.mcap", *make_drive(int(share * DRIVE_SWEEPS)))
    write_kitti(staged / "kitti", int(share * KITTI_SWEEPS))
    write_data_set(staged / "dataset", "kitti", *make_drive(int(share * JOB_SWEEPS)))
    staged.rename(folder)


def read_items(path):
    """Open a recording and read its positions in meters and all columns."""
    from lidarfiles.recordings.opening import open_recording

    recording = open_recording(path)
    count = 0
    for number in range(len(recording)):
        item = recording[number]
        _ = np.asarray(item.points, np.float64), *map(np.asarray, item.columns.values())
        count += len(item)
    return count


def view(path):
    from lidarfiles.recordings.opening import open_sensors
    from lidarpool.pages.recorded import recorded_view

    return len(recorded_view(open_sensors(path), "recording", None).points)


def read_scene(path):
    """Read points as `lidarpool scene points` does before it makes surfels."""
    from lidarscenario.points.point_files import read_points

    points = read_points(path, None, lambda _: None)
    return len(points[0] if isinstance(points, tuple) else points)


def read_epoch(path):
    """Iterate once over all sweeps of a data set."""
    values = ((sweep.points, sweep.columns, sweep.pose, sweep.boxes) for sweep in lp.sweeps(path))
    return sum(len(points) for points, *_ in values)


def read_torch_epoch(path):
    """Iterate once over all sweeps of a data set, converted to tensors."""
    return sum(len(item["points"]) for item in lp.sweeps(path).torch())


ACTIONS = {  # {name: (function that returns the number of points it has read, input)}
    "read LAS": (read_items, "survey.las"),
    "read MCAP": (read_items, "drive.mcap"),
    "read KITTI": (read_items, "kitti"),
    "view LAS": (view, "survey.las"),
    "view MCAP": (view, "drive.mcap"),
    "scene from LAS": (read_scene, "scene.las"),
    "epoch": (read_epoch, "dataset"),
    "epoch with torch": (read_torch_epoch, "dataset"),
}


def measure(name, folder, size):
    """Print an action's minimum time in this process and its number of points as JSON."""
    (action, file), seconds = ACTIONS[name], []
    action(folder / "small" / file)
    while sum(seconds) < LEAST_S:
        took, count = time_call(lambda: action(folder / size / file))
        seconds.append(took)
    print(json.dumps([min(seconds), count]))


def measure_in_process(checkout, name, folder, size):
    """Run an action in a new process, and return its time in seconds and its number of points."""
    paths = os.pathsep.join(f"{checkout}/{part}" for part in ("kernels", "scheduler", "workflows"))
    command = [sys.executable, "-m", __spec__.name, "--measure", name, "--folder", str(folder)]
    command += ["--quick"] if size == "small" else []
    # By default, glibc decides from earlier allocations whether large arrays reuse memory, which
    # changes the time to read a bag threefold.
    reuse = {"MALLOC_MMAP_THRESHOLD_": str(1 << 30), "MALLOC_TRIM_THRESHOLD_": str(1 << 34)}
    environment = os.environ | reuse | {"PYTHONPATH": paths}
    return json.loads(subprocess.check_output(command, cwd=ROOT, env=environment))


def compare(name, checkouts, pairs, folder, size):
    """Print a row for an action, and return its time in each checkout and the number of points."""
    calls = {
        str(checkout): lambda _, checkout=checkout: measure_in_process(checkout, name, folder, size)
        for checkout in checkouts
    }
    results = run_rounds(calls, pairs)  # the first round fills the file cache
    counts = {count for rounds in results.values() for _, count in rounds}
    if len(counts) > 1:
        raise SystemExit(f"{name}: the versions read different numbers of points: {counts}.")
    seconds = {checkout: [s for s, _ in rounds] for checkout, rounds in results.items()}
    cells = [np.median(values) for values in seconds.values()]
    if len(cells) > 1:
        cells.append(median_ratio(*seconds.values()))
    print(f"{name:18}{counts.pop():12,}" + "".join(f"{cell:9.3f}" for cell in cells), flush=True)
    return seconds


def main(arguments=None):
    parser = argument_parser(__doc__, repeat=5, quick=True)
    parser.add_argument("--against", type=Path, metavar="CHECKOUT", help="another checkout")
    parser.add_argument("--folder", type=Path, default=ROOT / "build" / "recordings")
    parser.add_argument("--only", nargs="+", choices=ACTIONS, default=[*ACTIONS])
    parser.add_argument("--measure", choices=ACTIONS, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.against and not (options.against / "workflows" / "lidarpool").is_dir():
        parser.error(f"{options.against} is not a checkout of lidarpool")
    size = "small" if options.quick else "full"
    if options.measure:
        measure(options.measure, options.folder, size)
        return
    folder = options.folder.resolve()
    write_inputs(folder / "small", SMALL)
    if not options.quick:
        write_inputs(folder / "full")
    checkouts = [ROOT] if options.against is None else [ROOT, options.against.resolve()]
    titles = ("s", "other s", "ratio")[: 2 * len(checkouts) - 1]
    print(f"{'action':18}{'points':>12}" + "".join(f"{title:>9}" for title in titles))
    results = {
        name: compare(name, checkouts, options.repeat, folder, size)
        for name in options.only
        if "torch" not in name or find_spec("torch")
    }
    write_results(options.json, results)


if __name__ == "__main__":
    main()
