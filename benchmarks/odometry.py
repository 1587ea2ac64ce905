"""Measure how well KISS-ICP deskews the points in an exported bag.

    python -m benchmarks.odometry [--sweeps 64] [--model ouster/os1-64]

A car drives along a street of the generated city and turns left. A bag contains each point in the
sensor frame at its firing, as drivers publish it. KISS-ICP (Vizzo et al., 2023) estimates the
motion and moves the points of a sweep to its end. The table lists the distances of these points
from their true positions. With deskewing, the distances are only small if the points in the bag are
not motion-compensated.

The benchmark requires KISS-ICP (`pip install kiss-icp`) and the `ros` extra of lidarpool.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarpool import Mounted, Pose, Scene, Survey, Track, load_sensor, save_cloud
from lidarscenes.procedural.city import city
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.table import SCAN
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps

from .harness import argument_parser, print_row, write_results

SPEED_MPS = 6.0
RADIUS_M = 9.0
STRAIGHT_M = 14.0
RAMP_M = 3.0  # half of the path on which the curvature begins and ends
STEP_S = 0.05  # between poses of the track
# of the sensors at 10 Hz
SWEEP_S = 0.1
STEPS_PER_SWEEP = 36
HEIGHT_M = 1.9  # of the sensor above the ground
VOXEL_M = 1.0
MAX_RANGE_M = 200.0
WARM_UP = 6  # sweeps in which KISS-ICP knows no motion yet


class Distances(NamedTuple):
    """Distances between deskewed points and their true positions, in meters."""

    median: float
    percentile_95: float


def left_turn(duration_s: float) -> Track:
    """Make a drive at constant speed that goes straight, turns left by 90°, and goes straight."""
    times_s = np.arange(0, duration_s + 2 * STEP_S, STEP_S)
    turned = STRAIGHT_M + RADIUS_M * np.pi / 2
    corners = np.add.outer((STRAIGHT_M, turned), (-RAMP_M, RAMP_M)).ravel()
    yaw_rate = np.interp(
        SPEED_MPS * times_s, corners, np.array([0, 1, 1, 0]) * SPEED_MPS / RADIUS_M
    )
    yaw = np.cumsum(yaw_rate) * STEP_S
    zero = np.zeros_like(yaw)
    velocity = SPEED_MPS * np.stack([np.cos(yaw), np.sin(yaw), zero], axis=1)
    positions = np.cumsum(velocity, axis=0) * STEP_S + (-20.0, -3.0, 0.0)
    quaternions = np.stack([zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)], axis=1)
    return Track(times_s, positions, quaternions, smooth=True)


def survey_of(model: str, sweeps: int) -> Survey:
    """Make a survey of a car-mounted sensor with `sweeps` sweeps."""
    sensor = load_sensor(model)
    track = left_turn(sweeps * SWEEP_S + SWEEP_S)
    return Survey(
        sensors=[Mounted(sensor, Pose((0, 0, HEIGHT_M)), "lidar")],
        trajectory=track,
        steps=STEPS_PER_SWEEP * sweeps,
        columns=("time", "intensity"),
        precision_m=1e-4,
    )


def cloud_of(survey: Survey, scene: Scene) -> Cloud:
    """Cast a survey in this process and return its cloud."""
    rig = Rig(scene, survey, "auto")
    part = columns_of(list(rig.cast(0, survey.scan_count)))
    cloud = part.cloud((SCAN, *survey.stored_columns[3:]), survey.precision_m, scene.origin)
    sweeps = Sweeps.from_survey(survey, scene)
    return replace(cloud, sweeps=lambda: sweeps)


def true_points(survey: Survey, cloud: Cloud) -> list[Any]:
    """Return the points of each sweep in the sensor frame at the end of the sweep."""
    sweeps = cloud.sweeps()
    points = []
    for number, sweep in enumerate(sweeps.points(cloud)):
        end = survey.path.pose(0, float(sweeps.ends_ns[number]))
        sensor = end.compose(survey.mounted_sensors[0].mount)
        points.append((sweep.positions - np.array(sensor.position)) @ sensor.rotation_matrix)
    return points


def distances(bag: Path, expected: list[Any], *, deskew: bool) -> Distances:
    """Process a bag with KISS-ICP, and return how far its points are from the expected points."""
    from kiss_icp.config.parser import load_config
    from kiss_icp.datasets.rosbag import RosbagDataset
    from kiss_icp.kiss_icp import KissICP

    config = load_config(None)
    config.data.deskew = deskew
    config.data.max_range = MAX_RANGE_M
    config.data.min_range = 0.0
    config.mapping.voxel_size = VOXEL_M
    odometry = KissICP(config)
    data = RosbagDataset(bag, "/lidar/points")
    errors_m = []
    for number in range(len(data)):
        points, _ = odometry.register_frame(*data[number])
        if number >= WARM_UP:
            errors_m.append(np.linalg.norm(np.asarray(points) - expected[number], axis=1))
    return Distances(*np.quantile(np.concatenate(errors_m), (0.5, 0.95)).tolist())


def measured(model: str, sweeps: int, triangles: int) -> dict[bool, Distances]:
    """Return the distances for the bag of a simulated drive, with and without deskewing."""
    survey = survey_of(model, sweeps)
    cloud = cloud_of(survey, city(triangles))
    expected = true_points(survey, cloud)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "drive"
        save_cloud(cloud, bag, format="rosbag2")
        return {deskew: distances(bag, expected, deskew=deskew) for deskew in (True, False)}


def main(arguments: list[str] | None = None) -> int:
    parser = argument_parser(__doc__, quick=True)
    parser.add_argument("--sweeps", type=int, default=64)
    parser.add_argument("--model", default="ouster/os1-64")
    options = parser.parse_args(arguments)
    if find_spec("kiss_icp") is None:
        print("This needs KISS-ICP: pip install kiss-icp.", file=sys.stderr)
        return 1
    if options.quick:
        options.sweeps = 14
        options.model = "velodyne/vlp16"
    results = measured(options.model, options.sweeps, 20_000 if options.quick else 200_000)
    print_row("deskewing", "median (m)", "95th percentile (m)")
    print("|---|--:|--:|")
    for deskew, errors in results.items():
        words = "on" if deskew else "off"
        print_row(words, f"{errors.median:.4f}", f"{errors.percentile_95:.4f}")
    write_results(options.json, {str(deskew): errors for deskew, errors in results.items()})
    return 0


if __name__ == "__main__":
    sys.exit(main())
