"""Poses of many actors at once have the bits of each trajectory's own."""

from dataclasses import replace

import numpy as np
import pytest

from lidarsim import LidarError, Pose, Track
from lidarsim.casting.actor_trajectories import ActorTrajectories
from lidarsim.motion.trajectory import Stations


class Circle:
    """A user's own."""

    stations = 1
    moves = True
    duration_ns = np.inf

    def poses(self, station, times_ns):
        angle = times_ns / 1e9
        return np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1), None


def track(seed, **options):
    random = np.random.default_rng(seed)
    count = int(random.integers(2, 12))
    times = np.cumsum(random.uniform(0.01, 0.5, count))
    turns = random.normal(size=(count, 4))
    turns /= np.linalg.norm(turns, axis=1)[:, None]
    return Track(times, random.normal(size=(count, 3)), turns, **options)


WAYS = ActorTrajectories(
    [
        *(track(seed, beyond="hold") for seed in range(6)),
        track(7, smooth=True, beyond="hold"),
        Circle(),
        Stations((Pose((1, 2, 3), 20),)),
        Stations((Pose((1, 2, 3)),)),
        track(9, beyond="absent"),
        *(replace(track(10, smooth=s, beyond="hold"), quaternions=None) for s in (False, True)),
    ]
)


@pytest.mark.extended
@pytest.mark.parametrize(
    "members", [WAYS, ActorTrajectories(WAYS[:6]), ActorTrajectories(WAYS[7:9])]
)
@pytest.mark.parametrize("each", [1, 5])
def test_poses_are_those_of_each_trajectory(members, each):
    random = np.random.default_rng(0)
    number = np.repeat(random.integers(0, len(members), 300), each)
    times = np.repeat(random.uniform(-0.5e9, 4e9, 300), each)
    positions, rotations = members.poses(number, times)
    for way, at, position, rotation in zip(number, times, positions, rotations, strict=True):
        (place,), turns = members[way].poses(0, np.array([at]))
        assert np.array_equal(position, place)
        assert np.array_equal(rotation, np.eye(3) if turns is None else turns[0])


def test_a_time_outside_is_refused_as_by_the_trajectory():
    ways = ActorTrajectories([*WAYS, track(3)])
    last = ways[-1].duration_ns
    ways.poses(np.array([len(WAYS)]), np.array([last]))
    with pytest.raises(LidarError, match=r"The trajectory covers .* the last 1 s are not covered"):
        ways.poses(np.array([0, len(WAYS)]), np.array([0.0, last + 1e9]))


def test_there_may_be_none():
    positions, rotations = ActorTrajectories().poses(np.zeros(0, np.intp), np.zeros(0))
    assert positions.shape == (0, 3) and rotations.shape == (0, 3, 3)
    assert ActorTrajectories().presence_ns.shape == (0, 2)


@pytest.mark.parametrize("as_lists", [False, True])
def test_a_trajectory_may_give_lists_or_one_pose_for_all(as_lists):
    """As NumPy would take them."""

    class Still:
        stations = 1
        moves = True
        duration_ns = np.inf

        def poses(self, station, times_ns):
            if as_lists:
                return [[1.0, 2.0, 3.0]] * len(times_ns), [np.eye(3).tolist()] * len(times_ns)
            return np.array([1.0, 2.0, 3.0]), np.eye(3)

    places, turns = ActorTrajectories([Still()]).poses(np.zeros(2, int), np.array([0.0, 1.0]))
    assert places.tolist() == [[1, 2, 3]] * 2 and np.array_equal(turns, [np.eye(3)] * 2)
