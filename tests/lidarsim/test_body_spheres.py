"""Firings that can hit inserted bodies, compared with a cast of all sub-rays."""

from dataclasses import replace

import numpy as np
import pytest

from lidarsim.casting.motion import CastPoses
from lidarsim.motion.trajectory import Pose, Track
from lidarsim.scene.actors import Actor, box
from lidarsim.sensor.disc import Beam
from lidarsim.simulator.body_spheres import firings_near_bodies, ranges_of_firings
from lidarsim.simulator.recorded_sweeps import scene_of_bodies
from raybeam import Pattern, RayCaster, SubRays

FIRINGS, CHANNELS = 360, 16
BEAM = Beam.from_divergences(7, (0.01, 0.01), "uniform", 0.0)


def directions():
    azimuth = 2 * np.pi * np.arange(FIRINGS) / FIRINGS
    elevation = np.linspace(-0.3, 0.3, CHANNELS)
    level = np.cos(elevation)
    x = np.cos(azimuth)[:, None] * level
    y = np.sin(azimuth)[:, None] * level
    return np.stack([x, y, np.broadcast_to(np.sin(elevation), x.shape)], axis=2)


def hit_firings(mesh, pattern, poses):
    """Cast all sub-rays at a mesh."""
    rays = pattern.with_sub_rays(SubRays(BEAM.angles))
    hits = RayCaster(mesh.vertices, mesh.faces).scan(
        rays, **poses.for_subrays(0, FIRINGS * CHANNELS, len(BEAM)).caster_arguments
    )
    return np.unique(hits.ray // (CHANNELS * len(BEAM)))


@pytest.mark.parametrize("center", [(8, 3, 0.4), (-5, -1, -1), (0.5, 0.2, 0.1), (30, -20, 4)])
def test_all_firings_that_hit_a_moving_sensors_surroundings_are_found(center):
    mesh = box("Car", (4, 2, 1.5))
    mesh = replace(mesh, vertices=mesh.vertices + center)
    scene = scene_of_bodies((mesh,))
    positions = np.linspace((0, 0, 0), (1, 0.5, 0), FIRINGS) - scene.origin
    rotations = np.array([Pose((0, 0, 0), 0.1 * k).rotation for k in range(1, FIRINGS + 1)])
    poses = CastPoses(positions, rotations, CHANNELS)
    rays = directions()
    near = firings_near_bodies(scene, BEAM, poses, np.zeros(FIRINGS), rays)
    pattern = Pattern(rays.reshape(-1, 3), step=CHANNELS)
    moved = replace(mesh, vertices=mesh.vertices - scene.origin)
    hit = hit_firings(moved, pattern, poses)
    assert len(hit)
    assert near[hit].all()
    if np.linalg.norm(center) > 5:
        assert near.mean() < 0.4


def test_actors_are_found_where_they_are_at_the_time_of_a_firing():
    track = Track([0, 0.1], [[10, 10, 0], [10, -10, 0]])
    scene = scene_of_bodies((), (Actor(box("Car", (1, 1, 1)), track),))
    poses = CastPoses(-scene.origin)
    times_ns = 1e8 * np.arange(FIRINGS) / FIRINGS
    near = firings_near_bodies(scene, BEAM, poses, times_ns, directions())
    # When the sensor looks at an azimuth of 38 degrees, the actor is at (10, 7.9).
    assert near[38]
    assert not near[[0, 45, 315]].any()
    still = firings_near_bodies(scene, BEAM, poses, np.full(FIRINGS, 5e7), directions())
    assert still[0]
    assert not still[38]


def test_ranges_cover_all_firings_and_consist_of_whole_blocks():
    near = np.zeros(1000, np.bool_)
    near[[100, 101, 900]] = True
    ranges = [*ranges_of_firings(near, 64)]
    assert ranges == [
        (0, 96, False), (96, 112, True), (112, 896, False), (896, 912, True), (912, 1000, False),
    ]  # fmt: skip
