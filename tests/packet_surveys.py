"""Surveys whose packets are tested, and the datagrams of their points."""

from __future__ import annotations

from functools import cache

import numpy as np
from tests.shapes import box, wall

from lidarsim import Scene
from lidarsim.columns.table import SCAN
from lidarsim.packets.encoders import PacketSource, encoder_of
from lidarsim.packets.shots import Shots
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps


@cache
def posts_before_walls() -> Scene:
    """Two walls with a gap between, and a row of posts that beams meet in part."""
    posts = [box(f"post {n}", (4, n / 2, -2), (4.05, n / 2 + 0.1, 2)) for n in range(-9, 10)]
    return Scene.from_meshes(
        [wall("left", 8, (1, 9), (-4, 4)), wall("right", 9, (-12, 0), (-4, 4)), *posts]
    )


def points_of(survey, scene):
    """Cast a survey; return its points and its sweeps."""
    rig = Rig(scene, survey, "tiles")
    part = columns_of(list(rig.cast(0, survey.scan_count)))
    cloud = part.cloud((SCAN, *survey.stored_columns[3:]), survey.precision_m, scene.origin)
    return cloud, Sweeps.from_survey(survey, scene)


def encoded(cloud, sweeps):
    """Return the groups of datagrams of all sweeps of a survey with one sensor."""
    encoder = encoder_of(PacketSource.for_sensor(sweeps, 0))
    groups = []
    for sweep, points in enumerate(sweeps.points(cloud)):
        groups += encoder.encode(Shots.from_points(sweeps, sweep, points, encoder.columns))
    return groups + encoder.finish()


def payloads_to(port, groups):
    """Return the payloads (n, size) of the datagrams to a port."""
    return np.concatenate([group.payloads for group in groups if group.port == port])
