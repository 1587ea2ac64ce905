"""Compare scenes reconstructed from public recordings with held-out sweeps.

    python -m benchmarks.reality FOLDER [NAME ...]

FOLDER contains the recordings, each in the folder of its repository:

| name | repository | sensor |
|---|---|---|
| `udacity` | udacity/SFND_Lidar_Obstacle_Detection | HDL-64E |
| `tram` | FrankMoosmann/FranksVelodyneAlgos | HDL-64E, range images |
| `kitti360` | heisenberg141/Pointcloud-Segmentation | HDL-64E |
| `hdl32` | cwchen1102/map_reconstruction | HDL-32E |
| `udacity-1` | udacity/SFND_Lidar_Obstacle_Detection | HDL-64E |
| `sfnd` | udacity/SFND_3D_Object_Tracking | HDL-64E |
| `foggy` | marcelsheeny/radiate_sdk | HDL-32E, in fog |

There are two rules for held-out sweeps: `easy` holds out every second sweep, and `hard` holds out
blocks of 20 sweeps. The static mask is independent of the twin. A point is static if sweeps that
are a second apart have points in its neighborhood. For scale, `next` compares each held-out sweep
with the next recorded sweep pulse by pulse, although the sensor moves between the two.

The recordings are not included in lidarpool, because they state no license. Download them yourself.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from lidarfiles.clouds.recording import Recording, RecordingInfo, RecordingSection
from lidarfiles.recordings.opening import open_recording, with_sweeps
from lidarreal.reconstruction.alignment import AlignedSweeps, first_alignment
from lidarreal.reconstruction.building import DEFAULT_VOXEL_M
from lidarreal.reconstruction.free_space import find_stationary_points
from lidarreal.reconstruction.held_out import HeldOutRays
from lidarreal.reconstruction.lost_pulses import SensorCoverage
from lidarreal.reconstruction.odometry import RecordedPoses
from lidarreal.reconstruction.range_noise import RingNeighbors, estimate_range_noise
from lidarreal.reconstruction.recorded_sweeps import RecordedSweeps
from lidarreal.reconstruction.submap_tasks import BuildTask, align_submap, compare_held_out_sweeps
from lidarreal.reconstruction.submaps import merge_alignments, split_into_submaps
from lidarreal.reconstruction.vehicle_detection import find_poses_and_vehicle
from lidarsim.columns.sweep import Sweep
from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.numerics.even_samples import even_indices

from .augmentation_fog import CSVRecording
from .harness import argument_parser, write_results

_COMPARED_SWEEPS = 24
_BLOCK_SWEEPS = 20
_STATIC_VOXEL_M = 0.4
_STATIC_SWEEPS = 10  # between sweeps that have points at the same surface_map: a second
_RESAMPLES = 400  # of sweeps, for intervals
_NOISE_SWEEPS = 13  # of the map, from which the range noise is estimated
_IMAGE_COLUMNS = 870  # of the cells in which two recorded sweeps are compared
_TRAM = Path("exampleData/MuehlburgerTor/velodyne_dist")


class Source(NamedTuple):
    """Public recording, and how its files are opened."""

    repository: str
    open: Callable[[Path], Recording]
    parts: dict[str, slice]  # {name: sweeps}


def _opened(folder: str) -> Callable[[Path], Recording]:
    return lambda root: with_sweeps(open_recording(root / folder))


class _Tram(Recording):
    """Range images.

    These are 16-bit PNG files with a row for each ring, in which 0 means no return.
    """

    def __init__(self, root: Path) -> None:
        super().__init__(RecordingInfo("tram"))
        self._files = sorted((root / _TRAM / "data").glob("*.png"))
        entries = (root / _TRAM / "velodyne_config.txt").read_text().splitlines()[-1].split()
        steps_per_m, column_count, ring_count, start_deg, stop_deg = map(float, entries[:5])
        elevation = -np.radians(np.array(entries[5:], np.float64))
        assert len(elevation) == ring_count
        columns = np.arange(int(column_count))
        azimuth = np.radians(start_deg + (columns + 0.5) * (stop_deg - start_deg) / column_count)
        level = np.cos(elevation)[:, None]
        self._steps_per_m = steps_per_m
        self._directions = np.stack(
            [
                level * np.cos(azimuth),
                level * np.sin(azimuth),
                np.broadcast_to(np.sin(elevation)[:, None], (len(elevation), len(azimuth))),
            ],
            axis=2,
        )
        self._ring = np.arange(len(elevation)).repeat(len(azimuth))

    def __len__(self) -> int:
        return len(self._files)

    def load(self, number: int) -> Sweep:
        range_m = np.asarray(Image.open(self._files[number]), np.float64) / self._steps_per_m
        points = (range_m[..., None] * self._directions).reshape(-1, 3)
        return Sweep(points, {"ring": self._ring})


SOURCES = {
    "udacity": Source(
        "SFND_Lidar_Obstacle_Detection",
        _opened("src/sensors/data/pcd/data_2"),
        {"drive": slice(None)},
    ),
    "tram": Source(
        "FranksVelodyneAlgos", _Tram, {"standing": slice(0, 100), "driving": slice(-160, None)}
    ),
    "kitti360": Source(
        "Pointcloud-Segmentation",
        _opened("data/velodyne_points/good_data"),
        {"drive": slice(None)},
    ),
    "hdl32": Source("map_reconstruction", _opened("pcd"), {"drive": slice(None)}),
    "udacity-1": Source(
        "SFND_Lidar_Obstacle_Detection",
        _opened("src/sensors/data/pcd/data_1"),
        {"drive": slice(None)},
    ),
    "sfnd": Source(
        "SFND_3D_Object_Tracking",
        _opened("images/KITTI/2011_09_26/velodyne_points/data"),
        {"drive": slice(None)},
    ),
    "foggy": Source(
        "radiate_sdk",
        lambda root: CSVRecording(root / "data/radiate/tiny_foggy/velo_lidar"),
        {"drive": slice(None)},
    ),
}


def part_of(recording: Recording, chosen: slice) -> Recording:
    """Return the given consecutive sweeps of a recording."""
    numbers = range(len(recording))[chosen]
    return RecordingSection(recording, numbers.start, len(numbers))


def mapped_sweeps(count: int, rule: str) -> Ints:
    """Return the numbers of the sweeps from which the map is built."""
    numbers = np.arange(count)
    if rule == "easy":
        return numbers[::2]
    block = numbers // _BLOCK_SWEEPS
    held_out = (block % 2 == 1) & ((block + 1) * _BLOCK_SWEEPS < count)
    return numbers[~held_out]


def static_points(sweeps: AlignedSweeps, numbers: Ints) -> dict[int, Bools]:
    """Return a mask of the static points of each sweep.

    A point is static if sweeps at least a second apart have points in its voxel.

    The mask does not depend on the twin, because no rays are cast.
    """
    keys = []
    for number in range(sweeps.recorded.count):
        cells = np.unique(_cells(sweeps.read(number).world), axis=0)
        keys.append(np.column_stack([cells, np.full(len(cells), number)]))
    table = np.concatenate(keys)
    lower = table[:, :3].min(axis=0)
    spans = np.ptp(table[:, :3], axis=0) + 1
    code = np.ravel_multi_index(tuple((table[:, :3] - lower).T), tuple(spans))
    order = np.lexsort((table[:, 3], code))
    code = code[order]
    sweep = table[order, 3]
    starts = np.flatnonzero(np.diff(code, prepend=-1))
    stops = np.append(starts[1:], len(code)) - 1
    static_codes = code[starts][sweep[stops] - sweep[starts] >= _STATIC_SWEEPS]
    masks = {}
    for number in numbers.tolist():
        codes = np.ravel_multi_index(
            tuple((_cells(sweeps.read(number).world) - lower).T), tuple(spans)
        )
        masks[number] = np.isin(codes, static_codes)
    return masks


def _cells(world: Floats) -> Ints:
    """Return the voxel indices (n, 3) of the given points (n, 3)."""
    return np.floor(world / _STATIC_VOXEL_M).astype(np.int64)


def to_next(
    sweeps: RecordedSweeps, numbers: Ints, coverage: SensorCoverage
) -> dict[str, float | None]:
    """Compare the ranges of each sweep with those of the next recorded sweep.

    The results include the F1 score of "no return" in the image cells that the sensor covers.
    """
    images = {
        n: _range_image(sweeps, n) for n in np.unique([numbers, numbers + 1]) if n < sweeps.count
    }
    share = (np.arange(_IMAGE_COLUMNS) + 0.5) / _IMAGE_COLUMNS
    columns = (share * coverage.cells.shape[1]).astype(np.int64)
    is_covered = coverage.cells[:, columns]
    differences = []
    lost_in_both = 0
    lost = 0
    for number in numbers.tolist():
        if number + 1 == sweeps.count:
            continue
        one, following = images[number], images[number + 1]
        both = np.isfinite(one) & np.isfinite(following)
        differences.append(np.abs(one - following)[both])
        is_lost, is_lost_next = (np.isnan(image) & is_covered for image in (one, following))
        lost_in_both += int((is_lost & is_lost_next).sum())
        lost += int(is_lost.sum() + is_lost_next.sum())
    if not differences:
        return {}
    difference_m = np.concatenate(differences)
    return {
        "median_size_m": float(np.median(difference_m)),
        "p90_size_m": float(np.quantile(difference_m, 0.9)),
        "f1": 2 * lost_in_both / max(lost, 1),
    }


def _range_image(sweeps: RecordedSweeps, number: int) -> Floats:
    """Return a sweep's range image, with NaN where there is no return."""
    sweep = sweeps.read(number)
    image = np.full((sweeps.ring_count, _IMAGE_COLUMNS), np.nan)
    turns = np.arctan2(sweep.points[:, 1], sweep.points[:, 0]) / (2 * np.pi) + 0.5
    column = (turns * _IMAGE_COLUMNS).astype(np.int64) % _IMAGE_COLUMNS
    image[sweep.columns["row"], column] = np.linalg.norm(sweep.points, axis=1)
    return image


def roughness(sweeps: AlignedSweeps, rays: HeldOutRays, mapped: Ints) -> dict[str, float]:
    """Return the roughness of the recorded and the simulated surfaces along the rings, in meters.

    It is the median absolute second difference of the ranges of three neighboring pulses that
    return in both. The simulated ranges have the noise that is estimated from the sweeps of the
    map, and `without_noise` is the roughness of the map.
    """
    some = mapped[even_indices(len(mapped), _NOISE_SWEEPS)]
    noise = estimate_range_noise(sweeps, some.tolist())
    sigma_m = 0.0 if noise is None else noise.range_m
    random = np.random.default_rng(0)
    differences = []
    for number in np.unique(rays.sweep).tolist():
        recorded = sweeps.recorded
        of_sweep = rays.select((rays.sweep == number) & rays.return_mask)
        triples = RingNeighbors.from_sweep(recorded.read(number), recorded.lasers)
        noisy_m = of_sweep.simulated_m + sigma_m * random.standard_normal(len(of_sweep.ring))
        ranges_m = np.stack([of_sweep.range_m, noisy_m, of_sweep.simulated_m])
        second_m = (
            ranges_m[:, triples.before] - 2 * ranges_m[:, triples.at] + ranges_m[:, triples.after]
        )
        differences.append(np.abs(second_m[:, np.isfinite(second_m).all(axis=0)]))
    medians_m = np.median(np.concatenate(differences, axis=1), axis=1).tolist()
    return {
        "noise": sigma_m,
        **dict(zip(("recorded", "simulated", "without_noise"), medians_m, strict=True)),
    }


def interval(
    rays: HeldOutRays, figure: Callable[[HeldOutRays], float | None]
) -> list[float] | None:
    """Return the 95 % confidence interval of a measure, estimated by bootstrapping over sweeps."""
    random = np.random.default_rng(0)
    numbers = np.unique(rays.sweep)
    by_sweep = [figure(rays.select(rays.sweep == number)) for number in numbers]
    values = np.array([np.nan if value is None else value for value in by_sweep])
    if not np.isfinite(values).any():
        return None
    means = [np.nanmean(random.choice(values, len(values))) for _ in range(_RESAMPLES)]
    low, high = np.quantile(means, (0.025, 0.975)).tolist()
    return [low, high]


def measure(name: str, root: Path, rules: tuple[str, ...]) -> list[dict[str, Any]]:
    """Build the twins of a recording for each rule, and print and return a row for each twin."""
    source = SOURCES[name]
    rows = []
    whole = source.open(root / source.repository)
    whole_sweeps = RecordedSweeps.from_recording(whole)
    for part, chosen in source.parts.items():
        recording = part_of(whole, chosen)
        poses, recorded = find_poses_and_vehicle(RecordedSweeps.from_recording(recording), None)
        coverage = SensorCoverage.from_sweeps(replace(whole_sweeps, vehicle=recorded.vehicle))
        for rule in rules:
            mapped = mapped_sweeps(recorded.count, rule)
            if len(mapped) == recorded.count:
                continue  # too few sweeps for a block between others
            started = time.perf_counter()
            row = _row(recorded, poses, mapped, coverage)
            row |= {
                "recording": f"{name}, {part}",
                "rule": rule,
                "sweeps": recorded.count,
                "length_m": float(
                    np.linalg.norm(np.diff(poses.matrices[:, :3, 3], axis=0), axis=1).sum()
                ),
                "seconds": time.perf_counter() - started,
                "gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
            }
            print(_line(row), flush=True)
            rows.append(row)
    return rows


def _row(
    recorded: RecordedSweeps, poses: RecordedPoses, mapped: Ints, coverage: SensorCoverage
) -> dict[str, Any]:
    """Return the results for the held-out sweeps of a recording."""
    first = first_alignment(recorded, poses)
    submaps = split_into_submaps(first.poses[:, :3, 3])
    counting = np.concatenate([submap.own_numbers for submap in submaps])
    held_out = np.setdiff1d(counting, mapped)
    compared = held_out[even_indices(len(held_out), _COMPARED_SWEEPS)]
    coverage = AlignedSweeps(recorded, first, coverage).find_coverage(mapped)
    task = BuildTask(
        recorded, first, submaps[0], mapped, coverage, compared, DEFAULT_VOXEL_M, drawn_share=0.0
    )
    aligned = [align_submap(replace(task, submap=submap))[0] for submap in submaps]
    task = replace(task, alignment=merge_alignments(first, submaps, aligned))
    sweeps = AlignedSweeps(recorded, task.alignment, coverage)
    rays = HeldOutRays.concatenate(
        [
            part
            for submap in submaps
            if (part := _compared(replace(task, submap=submap))) is not None
        ]
    )
    static = static_points(sweeps, compared)
    returned = np.concatenate([static[number] for number in compared.tolist()])
    is_static = np.zeros(len(rays.range_m), bool)
    is_static[rays.return_mask] = returned
    masked = replace(rays, standing=is_static)
    plane_m = [sweeps.alignment.plane_distance_m[number] for number in compared.tolist()]
    return {
        "twin": rays.figures(),
        "static": masked.figures()["stationary"],
        "static_share": float(returned.mean()),
        "interval_m": interval(
            rays.select(rays.standing),
            lambda part: part.figures()["all"]["median_abs_difference_m"],
        ),
        "next": to_next(recorded, compared, coverage),
        "roughness_m": roughness(sweeps, rays, np.intersect1d(counting, mapped)),
        "motion": sweeps.alignment.motion.value,
        "plane_m": float(np.nanmedian(plane_m)),
        "submaps": len(submaps),
    }


def _compared(task: BuildTask) -> HeldOutRays | None:
    """Return the rays of a submap's held-out sweeps."""
    sweeps = task.read()
    standing = find_stationary_points(sweeps, task.submap.numbers.tolist())
    rays, _, _ = compare_held_out_sweeps(sweeps, task, standing)
    return rays


def _line(row: dict[str, Any]) -> str:
    """Format a row as text."""
    twin = row["twin"]
    standing = twin["stationary"]
    no_return = twin["no_return"] or {"f1": float("nan")}
    correlation = standing["rank_correlation"]
    rough_mm = {name: 1000 * value for name, value in row["roughness_m"].items()}
    return (
        f"{row['recording']} ({row['rule']}, {row['sweeps']} sweeps, {row['length_m']:.0f} m, "
        f"{row['motion']}): "
        f"half {1000 * standing['median_abs_difference_m']:.0f} mm "
        f"{[round(1000 * edge) for edge in row['interval_m'] or []]}, "
        f"90 % {1000 * standing['p90_abs_difference_m']:.0f}, "
        f"median {1000 * standing['median_difference_m']:+.0f}, "
        f"static mask {1000 * row['static']['median_abs_difference_m']:.0f} "
        f"({100 * row['static_share']:.1f} %), next {1000 * row['next']['median_size_m']:.0f} "
        f"(F1 {row['next']['f1']:.2f}), "
        f"planes {1000 * row['plane_m']:.1f}, noise {rough_mm['noise']:.1f}, roughness "
        f"{rough_mm['simulated']:.1f} / {rough_mm['recorded']:.1f} (without noise "
        f"{rough_mm['without_noise']:.1f}); missed {100 * standing['no_surface']:.2f} %, F1 "
        f"{no_return['f1']:.3f}, points {twin['points']:.3f}, by ring "
        f"{twin['points_by_ring']:.3f}; rank "
        f"{'–' if correlation is None else format(correlation, '.2f')}; {row['seconds']:.0f} s, "
        f"{row['gib']:.1f} GiB"
    )


def main(arguments: list[str] | None = None) -> list[dict[str, Any]]:
    """Measure the recordings in a folder, and print and return the rows."""
    parser = argument_parser(__doc__)
    parser.add_argument("folder", type=Path, help="folder that contains the repositories")
    parser.add_argument("names", nargs="*", help=f"of {', '.join(SOURCES)} (default: all)")
    parser.add_argument("--rules", default="easy,hard", help="easy, hard, or both")
    options = parser.parse_args(arguments)
    rows = []
    for name in options.names or SOURCES:
        root = options.folder / SOURCES[name].repository
        if not root.is_dir():
            print(f"{name} is skipped, because {root} does not exist")
            continue
        rows += measure(name, options.folder, tuple(options.rules.split(",")))
    write_results(options.json, rows)
    return rows


if __name__ == "__main__":
    main()
