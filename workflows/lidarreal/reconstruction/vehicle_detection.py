"""Find the returns that come from the vehicle that carries the sensor.

The vehicle always has the same range in the same direction. On a level road, so does the ground.
They differ in what other sweeps observe: after the vehicle has moved, rays pass through its former
position, but the ground is still there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lidarfiles.clouds.rings import MIN_RINGS
from lidarsim.columns.sweep import Sweep
from lidarsim.numerics.arrays import Bools, Floats, Floats32, Ints
from lidarsim.numerics.even_samples import even_indices

from .alignment import transform_points
from .free_space import RangeImage
from .odometry import RecordedPoses, find_poses
from .recorded_sweeps import RecordedSweeps
from .vehicle_returns import VEHICLE_COLUMNS, VehicleReturns, vehicle_cells

_SWEEPS = 24  # number of sweeps that are examined
_MAX_RANGE_M = 5.0  # maximum range of the vehicle
_MIN_SHARE = 0.8  # minimum share of sweeps with a return from a cell of the vehicle
_MAX_SPREAD_M = 0.1  # maximum range between the quartiles of a cell
# Distances over which the vehicle has moved between compared sweeps.
_MIN_MOVED_M = 2.0
_MAX_MOVED_M = 12.0
_DILATION = 5  # size of the neighborhood of a cell
# Maximum share of returns from the vehicle that registration tolerates. In a drive of 71 m with a
# share of 0.03 %, they changed steps by less than 1 cm, and the last position by 3 mm.
_MAX_IGNORED_SHARE = 0.0005
_OUTLINE_M = 0.5  # minimum range difference between an object and what is behind its outline
# Maximum number of cells in which a part of the vehicle is visible in some sweeps, relative to
# those in which it is visible in nearly all sweeps.
_MAX_SWEPT = 1.5
_MIN_VOTES = 2  # minimum number of rays that pass through a cell of the vehicle


def find_poses_and_vehicle(
    recorded: RecordedSweeps, trajectory: Path | None
) -> tuple[RecordedPoses, RecordedSweeps]:
    """Find the poses of all sweeps, and the returns that do not come from the scene.

    Return the poses and the sweeps without the returns from the vehicle.

    Raises
    ------
    LidarError
        If the recording cannot be read, or in the cases of `find_poses`.
    """
    recorded = recorded.with_isolated_ranges()
    poses = find_poses(recorded, trajectory)
    vehicle = find_vehicle_returns(recorded, poses)
    recorded = replace(recorded, vehicle=vehicle)
    if vehicle.are_found:
        recorded = recorded.with_isolated_ranges()
        # Returns from the vehicle look as if it did not move.
        if not poses.are_given and vehicle.share > _MAX_IGNORED_SHARE:
            poses = find_poses(recorded, trajectory)
    return poses, recorded


def find_vehicle_returns(recorded: RecordedSweeps, poses: RecordedPoses) -> VehicleReturns:
    """Find the returns that come from the vehicle, given the poses of all sweeps.

    Nothing is found if the sensor is stationary or has no rings.

    Raises
    ------
    LidarError
        If the recording cannot be read.
    """
    from scipy.ndimage import binary_propagation

    shape = (recorded.ring_count, VEHICLE_COLUMNS)
    pairs = _moved_pairs(poses.matrices[:, :3, 3])
    if len(recorded.rings) < MIN_RINGS or not pairs:
        return _vehicle(np.zeros(shape, bool), np.full((1, *shape), np.nan, np.float32))
    near = [_near_returns(recorded, first) for first, _ in pairs]
    ranges_m = np.stack([_shortest_ranges(sweep, shape) for sweep in near])
    constant = _is_constant(ranges_m)
    if not constant.any():
        return _vehicle(constant, ranges_m)
    passing, confirming = _votes(recorded, poses, pairs, near)
    is_passed = constant & (passing >= _MIN_VOTES) & (passing > 2 * confirming)
    # Other sweeps cannot observe positions that the vehicle itself hides.
    unknown = constant & (passing >= confirming)
    is_passed = binary_propagation(is_passed, mask=unknown)
    shortest_m = np.stack([_shortest_ranges(recorded.read(first), shape) for first, _ in pairs])
    vehicle = _vehicle(_fixed_parts(is_passed, shortest_m), ranges_m)
    if not vehicle.are_found:
        return vehicle
    found = sum(int(vehicle.contain(sweep).sum()) for sweep in near)
    return vehicle._replace(share=found / sum(len(recorded.read(first)) for first, _ in pairs))


def _votes(
    recorded: RecordedSweeps,
    poses: RecordedPoses,
    pairs: Sequence[tuple[int, int]],
    near: Sequence[Sweep],
) -> tuple[Ints, Ints]:
    """Count the returns of each cell that other sweeps passed, and those that they confirm.

    `near` are the near returns of the first sweep of each pair. Both arrays have shape (r, c).
    """
    shape = (recorded.ring_count, VEHICLE_COLUMNS)
    passing, confirming = np.zeros((2, *shape), np.int64)
    for (first, second), sweep in zip(pairs, near, strict=True):
        cell = vehicle_cells(sweep.points, sweep.columns["row"])
        moved = np.linalg.inv(poses.matrices[second]) @ poses.matrices[first]
        passed, confirmed = _observe(recorded, second, transform_points(sweep.points, moved))
        np.add.at(passing, cell, passed)
        np.add.at(confirming, cell, confirmed)
    return passing, confirming


def _observe(recorded: RecordedSweeps, number: int, points: Floats) -> tuple[Bools, Bools]:
    """Mark points through which rays of a sweep passed, and those that the sweep confirms.

    The points are in the sensor frame of the sweep, and have shape (n, 3).
    """
    lasers = recorded.lasers.sort_by_elevation()
    return RangeImage.from_points(recorded.read(number).points, lasers).classify(points)


def _moved_pairs(positions: Floats) -> list[tuple[int, int]]:
    """Return pairs of sweeps between which the vehicle has moved, alternately forward and backward.

    The positions have shape (s, 3).
    """
    pairs = []
    for index, first in enumerate(even_indices(len(positions), _SWEEPS).tolist()):
        ways = [range(first + 1, len(positions)), range(first - 1, -1, -1)]
        found = [_first_moved(positions, first, others) for others in ways]
        seconds = [second for second in found if second is not None]
        if seconds:
            pairs.append((first, seconds[index % len(seconds)]))
    return pairs


def _first_moved(positions: Floats, first: int, others: Sequence[int]) -> int | None:
    """Return the first of the other sweeps that is far enough away, or None."""
    for other in others:
        distance_m = np.linalg.norm(positions[other] - positions[first])
        if distance_m > _MIN_MOVED_M:
            return other if distance_m < _MAX_MOVED_M else None
    return None


def _near_returns(recorded: RecordedSweeps, number: int) -> Sweep:
    """Return the returns of a sweep that may come from the vehicle."""
    sweep = recorded.read(number)
    return sweep.select(np.linalg.norm(sweep.points, axis=1) < _MAX_RANGE_M)


def _shortest_ranges(sweep: Sweep, shape: tuple[int, int]) -> Floats32:
    """Return the shortest range in each cell of a sweep, or NaN if there is no return.

    The array has the given shape, (r, c).
    """
    shortest = np.full(shape, np.inf, np.float32)
    cell = vehicle_cells(sweep.points, sweep.columns["row"])
    np.minimum.at(shortest, cell, np.linalg.norm(sweep.points, axis=1).astype(np.float32))
    shortest[np.isinf(shortest)] = np.nan
    return shortest


def _is_constant(ranges_m: Floats32) -> Bools:
    """Mark the cells whose range is the same in most sweeps.

    The ranges have shape (k, r, c).
    """
    often = np.isfinite(ranges_m).mean(axis=0) >= _MIN_SHARE
    constant = np.zeros(often.shape, bool)
    if often.any():
        low, high = np.nanquantile(ranges_m[:, often], (0.25, 0.75), axis=0)
        constant[often] = high - low < _MAX_SPREAD_M
    return constant


def _fixed_parts(cells: Bools, shortest_m: Floats32) -> Bools:
    """Omit connected parts of the cells whose outlines move, such as cars in the next lane.

    The flat side of a car that drives alongside has a constant range, but its ends do not remain in
    the same cells. `shortest_m` are the shortest ranges in all cells. Shape (k, r, c).
    """
    from scipy.ndimage import binary_dilation, binary_propagation, label

    around = np.ones((_DILATION, _DILATION), bool)  # Cells without rays separate parts.
    fixed = cells.copy()
    with_missing = np.where(np.isnan(shortest_m), np.float32(np.inf), shortest_m)
    count = len(with_missing)
    nearest_first = np.sort(with_missing, axis=0)
    low_m, high_m = nearest_first[count // 10], nearest_first[-1 - count // 10]
    changes = high_m > low_m + _OUTLINE_M
    parts, part_count = label(binary_dilation(cells, around))
    for part in range(1, part_count + 1):
        own = cells & (parts == part)
        visible = own | (changes & (low_m < float(low_m[own].max()) + _OUTLINE_M))
        swept = visible & binary_propagation(own, mask=binary_dilation(visible, around))
        if swept.sum() > _MAX_SWEPT * own.sum():
            fixed &= ~own
    return fixed


def _vehicle(cells: Bools, ranges_m: Floats32) -> VehicleReturns:
    """Return the ranges of the cells, of which each extends to its neighbors.

    The edges of the vehicle are not in the same cells in all sweeps.
    """
    from scipy.ndimage import maximum_filter

    farthest = np.full(cells.shape, -np.inf, np.float32)
    if cells.any():
        farthest[cells] = np.nanquantile(ranges_m[:, cells], 0.9, axis=0)
    return VehicleReturns(maximum_filter(farthest, _DILATION, mode=("nearest", "wrap")))
