"""What tests of casting share: a trajectory that moves, and batches cut anywhere."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from lidarpool import Pose


@dataclass(frozen=True)
class Cart:
    """Drives along x while it turns about z, in lanes that lie side by side."""

    speed: float = 5.0  # metres a second
    yaw_rate_deg: float = 90.0  # a second
    stations: int = 2
    moves: bool = True
    duration_ns: float = np.inf
    height: float = 1.0

    def pose(self, station, time_ns=0.0):
        seconds = time_ns / 1e9
        return Pose(
            (self.speed * seconds, 10.0 * station, self.height), self.yaw_rate_deg * seconds
        )

    def poses(self, station, times_ns):
        poses = [self.pose(station, time) for time in times_ns]
        rotations = [np.eye(3) if p.rotation is None else p.rotation for p in poses]
        return np.array([p.position for p in poses]), np.array(rotations)


def cast_between(rig, survey, cuts):
    """Columns as bytes, and {counter: hits}, of scans that are cast from cut to cut."""
    batches = [batch for span in itertools.pairwise(cuts) for batch in rig.cast(*span)]
    columns = {
        column.name: np.concatenate([batch.column(column) for batch in batches]).tobytes()
        for column in survey.stored_columns
    }
    return columns, tally_of(batches).tolist()


def tally_of(batches):
    """Hits of each triangle in all of these batches."""
    tally = np.zeros(batches[0].scene.counters, np.int64)
    for batch in batches:
        triangles, hits = batch.tally
        tally[triangles] += hits
    return tally
