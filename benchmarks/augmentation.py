"""Measure how closely augmented recordings match simulations, and how long augmentation takes.

    python -m benchmarks.augmentation [--only equivalence insertion speed]
    python -m benchmarks.augmentation --only fog --foggy FOLDER --clear FOLDER

- `equivalence`: a clear drive, augmented with weather, dirt, noise and faults, compared with the
  same drive simulated in these conditions. An asterisk marks distributions that differ at a
  significance of 0.001.
- `insertion`: a drive without a car, into which the car is inserted, compared with the drive with
  the car.
- `fog`: recorded sweeps in fog, compared with clear sweeps that are augmented with fog.
- `speed`: CPU time to augment a sweep, compared with reading it from a PCD file.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarfiles.recordings.opening import open_recording
from lidarpool import Noise, Sensor, Sweep, save_cloud
from lidarreal.augmentation.augmented_sweep import AugmentedSweep
from lidarreal.augmentation.augmenter import Augmenter
from lidarreal.augmentation.effects import Effects, Insertion
from lidarsim.media.weather import Weather
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.actors import box

from .augmentation_drives import (
    CAR_M,
    CLEAR,
    CONDITIONS,
    Drive,
    detecting_sensor,
    street,
)
from .augmentation_equivalence import (
    PULSE_KEY_NS,
    Comparison,
    augmented,
    compare,
    print_comparison,
    pulse_keys,
    simulated,
)
from .augmentation_fog import compare_fog
from .harness import argument_parser, print_row, run_rounds, time_call, write_results

SECTIONS = ("equivalence", "insertion", "speed", "fog")
# (sensor model, assumed detection range in meters or None, sweeps)
SENSORS = {
    "OS1-64": ("ouster/os1-64", None, 6),
    "VLP-16": ("velodyne/vlp16", 60.0, 10),
    "HDL-64E": ("velodyne/hdl64e-s3", 80.0, 4),
}
FORMATS: dict[str, dict[str, Any]] = {
    "MCAP": {"format": "mcap"},
    "MCAP, layout ouster": {"format": "mcap", "layout": "ouster"},
    "PCD": {"format": "pcd"},
}
FORMAT_CONDITIONS = ("rain, 25 mm/h", "fog, visibility 100 m", "snow, 2 mm/h", "saturation")
SUBRAY_CONDITIONS = ("rain, 25 mm/h", "fog, visibility 100 m", "snow, 2 mm/h", "dirt")
SAME_M = 0.05  # maximum distance of points that are the same
KITTI_SWEEPS = 7_481
SPEED_EFFECTS = {
    "no effects": Effects(),
    "rain": Effects(weather=Weather(rain_mm_h=25.0)),
    "fog": Effects(weather=Weather(visibility_km=0.1)),
    "snow": Effects(weather=Weather(snow_mm_h=2.0)),
    "inserted car": Effects(insertions=(Insertion(box("Car", CAR_M), 12.0, 3.0, -1.9),)),
}


def equivalence(quick: bool) -> dict[str, Any]:
    """Compare augmented drives with simulated drives."""
    results: dict[str, Any] = {}
    print_row(
        "drive",
        "surface returns, augmented / simulated",
        "z",
        "range",
        "intensity",
        "returns from the air",
        "z",
        "range",
        "intensity",
    )
    print_row(*["---"] * 9)
    for name, (model, detection_range_m, sweeps) in SENSORS.items():
        sensor = detecting_sensor(model, detection_range_m, 1)
        drive = Drive(_scene(quick), sensor, 2 if quick else sweeps)
        results[name] = _compared_conditions(name, drive, tuple(CONDITIONS), seeds=True)
    results |= _compared_formats(quick)
    for name, (model, detection_range_m, _) in SENSORS.items():
        drive = Drive(_scene(quick), detecting_sensor(model, detection_range_m, 7), 2)
        title = f"{name}, 7 sub-rays"
        results[title] = _compared_conditions(title, drive, SUBRAY_CONDITIONS, seeds=False)
    return results


def _scene(quick: bool) -> Any:
    return street(3_000 if quick else 30_000)


def _compared_conditions(
    title: str, drive: Drive, conditions: Sequence[str], *, seeds: bool
) -> dict[str, Any]:
    """Compare a drive in several conditions.

    With `seeds`, two simulations with different seeds are compared, too, as a reference.
    """
    clear = drive.recording()
    results = {}
    for name in conditions:
        condition = CONDITIONS[name]
        truth = simulated(drive.recording(condition, 1))
        first = augmented(clear, condition, drive.sensor, clear)
        results[name] = _shown(f"{title}: {name}", compare(first, truth))
        if seeds:
            other = simulated(drive.recording(condition, 2))
            reference = compare(other, truth)
            results[f"{name}, seeds"] = _shown(f"{title}: {name}, two seeds", reference)
    return results


def _shown(name: str, comparison: Comparison) -> dict[str, Any]:
    print_comparison(name, comparison)
    return comparison.to_dict()


def _compared_formats(quick: bool) -> dict[str, Any]:
    """Compare drives that were exported to files, and a motion-compensated drive."""
    sensor = detecting_sensor("ouster/os1-64", None, 1)
    drive = Drive(_scene(quick), sensor, 2 if quick else 6)
    cloud = drive.cloud()
    clear = open_recording(cloud)
    compensated = replace(drive, coordinates="world")
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, options in FORMATS.items():
            path = Path(folder) / (f"{len(results)}.mcap" if "mcap" in options["format"] else "pcd")
            save_cloud(cloud, path, **options)
            recording = open_recording(path, keep_noise=True)
            strength = "reflectivity" if "layout" in options else "intensity"
            results[name] = {}
            for condition in FORMAT_CONDITIONS:
                chosen = CONDITIONS[condition]
                first = augmented(recording, chosen, sensor, clear, strength)
                truth = simulated(drive.recording(chosen, 1), strength)
                comparison = compare(first, truth)
                results[name][condition] = _shown(f"{name}: {condition}", comparison)
    results["compensated"] = {}
    recording = compensated.recording()
    for condition in FORMAT_CONDITIONS:
        chosen = CONDITIONS[condition]
        first = augmented(recording, chosen, sensor, recording)
        truth = simulated(compensated.recording(chosen, 1))
        comparison = compare(first, truth)
        results["compensated"][condition] = _shown(f"compensated: {condition}", comparison)
    return results


class CarPoints(NamedTuple):
    """Numbers of points on cars, which were simulated or inserted.

    Points are the same if they are less than `SAME_M` apart.
    """

    simulated: int
    same: int
    without_pulse: int  # missing points whose pulse has no return in the recording without cars
    missing: int  # other missing points
    added: int  # inserted points without a simulated point
    outline: int  # recorded points of pulses at an outline that return from the car if simulated
    behind: int  # other recorded points of pulses that return from a car if simulated


def insertion(quick: bool) -> dict[str, Any]:
    """Insert cars that were removed from a drive, and compare it with the drive with the cars."""
    results: dict[str, Any] = {}
    print_row("sub-rays", *CarPoints._fields)
    print_row(*["---"] * (1 + len(CarPoints._fields)))
    for subrays in (1, 7):
        sensor = detecting_sensor("ouster/os1-64", None, subrays)
        noise = Noise(detection_range_m=sensor.noise.detection_range_m)
        with_cars = Drive(_scene(quick), replace(sensor, noise=noise), 2 if quick else 6)
        scene = with_cars.scene
        without = replace(with_cars, scene=scene.with_actors(()))
        truth = with_cars.recording()
        recording = without.recording()
        augmenter = Augmenter(recording, Effects(actors=scene.actors), with_cars.sensor)
        counts = [
            _car_points(truth[n], recording[n], augmenter.sweep(n), len(scene.names))
            for n in range(len(truth))
        ]
        total = CarPoints(*np.sum(counts, axis=0).tolist())
        results[str(subrays)] = total._asdict()
        print_row(subrays, *total)
    return results


def _car_points(truth: Sweep, recorded: Sweep, result: AugmentedSweep, first_car: int) -> CarPoints:
    """Compare the points on cars in a simulated and in an augmented sweep."""
    on_car = truth.select(np.asarray(truth.columns["object"]) >= first_car)
    inserted = result.sweep.points[~result.is_recorded]
    apart_m, _ = _nearest(on_car.points, inserted)
    extra_m, _ = _nearest(inserted, on_car.points)
    is_missing = apart_m >= SAME_M
    keys = pulse_keys(on_car)
    has_pulse = np.isin(keys, pulse_keys(recorded))
    # Pulses whose four neighbors also return from a car. Every other channel has the same azimuth.
    step = PULSE_KEY_NS * int(np.diff(np.unique(truth.columns["time"])).min())
    neighbors = (step, -step, 2, -2)
    inside = keys[np.all([np.isin(keys + offset, keys) for offset in neighbors], axis=0)]
    kept = pulse_keys(recorded)[result.template[result.is_recorded]]
    return CarPoints(
        len(keys),
        int((~is_missing).sum()),
        int((is_missing & ~has_pulse).sum()),
        int((is_missing & has_pulse).sum()),
        int((extra_m >= SAME_M).sum()),
        int((np.isin(kept, keys) & ~np.isin(kept, inside)).sum()),
        int(np.isin(kept, inside).sum()),
    )


def _nearest(points: Floats, others: Floats) -> tuple[Floats, Any]:
    from scipy.spatial import KDTree

    if not len(others):
        return np.full(len(points), np.inf), np.zeros(len(points), np.int64)
    return KDTree(others).query(points)


def speed(quick: bool, repeat: int) -> dict[str, Any]:
    """Measure the CPU time per sweep, relative to reading the sweep from a PCD file."""
    results: dict[str, Any] = {}
    for name in ("OS1-64", "HDL-64E"):
        model, detection_range_m, _ = SENSORS[name]
        sensor = detecting_sensor(model, detection_range_m, 1)
        results[name] = _timed(name, sensor, quick, repeat)
    return results


def _timed(name: str, sensor: Sensor, quick: bool, repeat: int) -> dict[str, Any]:
    drive = Drive(_scene(quick), sensor, 2 if quick else 5)
    folder = Path(tempfile.mkdtemp())
    try:
        path = folder / "pcd"
        save_cloud(drive.cloud(CLEAR), path, format="pcd")
        stored = open_recording(path, keep_noise=True)
        sweeps = [stored[number] for number in range(len(stored))]
        augmenters = {
            effect: Augmenter(stored, effects, sensor) for effect, effects in SPEED_EFFECTS.items()
        }

        def augment(augmenter: Augmenter, number: int) -> float:
            sweep = number % len(sweeps)
            return time_call(lambda: augmenter.augment(sweeps[sweep], sweep))[0]

        def read(number: int) -> float:
            return time_call(lambda: len(stored[number % len(stored)].returns()))[0]

        calls: dict[str, Callable[[int], float]] = {"read": read}
        for effect, augmenter in augmenters.items():
            calls[effect] = lambda number, augmenter=augmenter: augment(augmenter, number)
        seconds = {row: float(np.median(v)) for row, v in run_rounds(calls, repeat).items()}
    finally:
        shutil.rmtree(folder)
    results = {}
    points = int(np.mean([len(sweep) for sweep in sweeps]))
    print_row(f"{name}, {points:,} points", "ms", "× reading", "minutes for 7,481 sweeps")
    print_row("---", "--:", "--:", "--:")
    for row, value in seconds.items():
        # Two cores process different sweeps, which are also read.
        minutes = (value + seconds["read"] * (row != "read")) * KITTI_SWEEPS / 2 / 60
        results[row] = {"ms": 1e3 * value, "ratio": value / seconds["read"], "minutes": minutes}
        print_row(row, f"{1e3 * value:.1f}", f"{value / seconds['read']:.2f}", f"{minutes:.1f}")
    return results


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Print and return the results of the chosen sections."""
    parser = argument_parser(__doc__, repeat=9, quick=True)
    parser.add_argument("--only", nargs="*", choices=SECTIONS, default=SECTIONS[:3])
    parser.add_argument("--foggy", type=Path, help="folder of recorded sweeps in fog (CSV)")
    parser.add_argument("--clear", type=Path, help="recording of the same sensor in clear air")
    options = parser.parse_args(arguments)
    results: dict[str, Any] = {}
    if "equivalence" in options.only:
        results["equivalence"] = equivalence(options.quick)
    if "insertion" in options.only:
        results["insertion"] = insertion(options.quick)
    if "speed" in options.only:
        results["speed"] = speed(options.quick, options.repeat)
    if "fog" in options.only:
        if options.foggy is None:
            parser.error("--only fog requires --foggy FOLDER")
        results["fog"] = compare_fog(options.foggy, options.clear)
    write_results(options.json, results)
    return results


if __name__ == "__main__":
    main()
