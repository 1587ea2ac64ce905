"""Run a four-stage pipeline and 100 independent trials on one pool, with your own functions.

The pool is partitioned as in MATLAB's example: one worker per GPU, four workers for the pipeline,
and the remaining workers for other tasks. While stage 1 generates scans, each scan is processed in
a short task on the GPU partition. To use this program as a template, replace the bodies of the
functions and keep the pipes between them.

    python examples/own_stages.py
"""

import math

import numpy as np
import open3d as o3d

from poolpart import Pipe, Pool

SCANS = 36
RAYS = 500
ROOM = np.array([8.0, 6.0, 3.0])  # size in meters; the sensor is in the center
TRIALS = 100


def generate(scans):
    """Generate the parameters of each scan (stage 1).

    Here, this is the azimuth of the sensor head.
    """
    for scan in range(SCANS):
        scans.put((scan, 360 / SCANS * scan))
    scans.close()


def intersect(item, hits, frames):
    """Intersect the rays of a scan with the walls, as a task on the GPU partition (stage 2)."""
    scan, azimuth_deg = item
    azimuth = math.radians(azimuth_deg)
    elevations = np.radians(np.linspace(-45, 45, RAYS))
    directions = np.column_stack(
        [
            np.cos(elevations) * math.cos(azimuth),
            np.cos(elevations) * math.sin(azimuth),
            np.sin(elevations),
        ]
    )
    with np.errstate(divide="ignore"):
        ranges = (ROOM / 2 / np.abs(directions)).min(axis=1)
    hits.put((scan, directions * ranges[:, None]))
    frames.put((scan, ranges.mean()))


def sort_frames(frames, shown):
    """Sort the frames into scan order (stage 3).

    They arrive out of order if several workers intersect scans.
    """
    waiting = {}
    following = 0
    for scan, frame in frames:
        waiting[scan] = frame
        while following in waiting:
            shown.put((following, waiting.pop(following)))
            following += 1
    shown.close()


def collect(hits):
    """Return all points received by this task, which is one of two collectors (stage 4)."""
    return dict(hits)


def plan(trial):
    """Return the length of a path that avoids a pillar by passing through a random point."""
    beside = np.random.default_rng(trial).uniform(-3, 3)
    if abs(beside) < 1:  # within the pillar
        return math.inf
    return 2 * math.hypot(4, beside)


def main():
    with Pool.local({"GPU": (1, 1), "LIDAR": (4, 1), "OTHER": (2, 1)}) as pool:
        gpu, lidar, other = pool["GPU"], pool["LIDAR"], pool["OTHER"]
        pipes = [Pipe(name, 4, pool.client) for name in ("scans", "hits", "frames", "shown")]
        scans, hits, frames, shown = [pipe.create() for pipe in pipes]
        stages = [lidar.submit(generate, scans), lidar.submit(sort_frames, frames, shown)]
        casting = gpu.for_each(scans, intersect, hits=hits, frames=frames, wait=False)
        collectors = [lidar.submit(collect, hits) for _ in range(2)]
        lengths = other.map(plan, range(TRIALS), ordered=False)
        with shown.listen(lambda frame: print(f"scan {frame[0]}: {frame[1]:.2f} m on average")):
            best = min(lengths)
            casting.result()  # all scans have been cast, so no more items follow
            hits.close()
            frames.close()
        for stage in stages:
            stage.result()  # raises the error if the stage has failed
        points = {}
        for collector in collectors:
            points |= collector.result()

    cloud = o3d.t.geometry.PointCloud(np.vstack([points[scan] for scan in range(SCANS)]))
    o3d.t.io.write_point_cloud("own-stages.ply", cloud)
    print(f"{SCANS * RAYS:,} points in own-stages.ply; the best of {TRIALS} ways is {best:.2f} m")


if __name__ == "__main__":
    main()
