"""Planning: descriptions, trials, and shortest paths against formulas."""

from __future__ import annotations

import hashlib
import math
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from lidarscenario import Planning
from lidarscenario.plan import Trial, best, run_trial, shortest_path_length
from lidarscenario.plan.cost import PathCost
from lidarscenario.plan.geometry import clearance, segment_distances
from lidarsim import LidarError

SEED_SCENE = [(-20, -20), (20, -20), (-20, 20), (20, 20), (-10, -5), (5, 5)]
DEFAULT = Planning((25, 25), (-30, -20), SEED_SCENE, 2.0)
SMALL = Planning((25, 25), (-30, -20), SEED_SCENE, 2.0, particles=60, iterations=40, seed=7)


def bits(trial):
    return trial.waypoints.tobytes() + bytes([trial.collision_free])


def fingerprint():
    """Of a few trials; run by this test in other processes too, so it imports nothing local."""
    return hashlib.sha256(b"".join(bits(run_trial(SMALL, n)) for n in range(3))).hexdigest()


scene = st.lists(
    st.tuples(st.integers(-24, 24), st.integers(-24, 24), st.floats(0.5, 7)),
    min_size=3,
    max_size=12,
)


@pytest.mark.slow
@settings(max_examples=8, derandomize=True)
@given(discs=scene)
def test_random_scenes(discs):
    array = np.array(discs, float)
    centers = array[:, :2]
    radii = array[:, 2]
    ends = np.array([DEFAULT.start, DEFAULT.target])
    assume((segment_distances(ends, ends, centers) > radii + 0.1).all())
    planning = Planning(DEFAULT.start, DEFAULT.target, centers, radii)
    shortest = shortest_path_length(planning.start, planning.target, centers, radii)
    assume(shortest < np.inf)
    plan = best([run_trial(planning, number) for number in range(4)], planning)
    assert plan.collision_free
    assert plan.clearance >= 0
    assert shortest - 1e-9 <= plan.length <= 1.05 * shortest


def test_georeferenced_and_tiny_scenes_give_the_same_plan():
    for scale, east, north in ((1, 500_000, 5_400_000), (1e-3, 0, 0), (1e4, 0, 0)):
        shift = np.array([east, north])
        planning = Planning(
            tuple(scale * np.array([25, 25]) + shift),
            tuple(scale * np.array([-30, -20]) + shift),
            scale * np.array(SEED_SCENE) + shift,
            scale * 2.0,
        )
        plan = best([run_trial(planning, 0)], planning)
        assert plan.collision_free
        assert plan.length == pytest.approx(scale * 71.2034, rel=1e-3)


@pytest.mark.parametrize("particles", [1, 2, 19, 97, 100])
@pytest.mark.parametrize("waypoints", [1, 4])
def test_any_number_of_particles_runs(particles, waypoints):
    planning = Planning(
        centers=SEED_SCENE, radii=2, particles=particles, iterations=3, waypoints=waypoints
    )
    trial = run_trial(planning, 0)
    assert trial.waypoints.shape == (waypoints, 2)
    assert np.isfinite(trial.waypoints).all()


def test_a_trial_does_not_claim_a_path_that_collides():
    """One particle that never moved: some paths are free, some enter a disc by little or much."""
    planning = Planning((-5, 0), (5, 0), [(0, 0)], 1.0, particles=1, iterations=1, waypoints=1)
    rooms = []
    for number in range(60):
        trial = run_trial(planning, number)
        path = np.vstack([planning.start, trial.waypoints, planning.target])
        rooms.append(clearance(path, planning.centers, planning.radii))
        assert trial.collision_free == (rooms[-1] >= 0)
    assert max(rooms) > 0
    assert any(-0.5 < room < 0 for room in rooms)


@pytest.mark.extended
def test_another_process_without_wide_vector_instructions_gives_the_same_bits():
    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    script = (
        "import importlib.util as u; "
        f"s = u.spec_from_file_location('trials', {__file__!r}); "
        "m = u.module_from_spec(s); s.loader.exec_module(m); print(m.fingerprint())"
    )
    environment = {**os.environ, "NPY_DISABLE_CPU_FEATURES": " ".join(found)}
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=environment, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.stdout.strip() == fingerprint(), done.stderr


def test_the_bits_are_these():
    """From any machine: only operations that IEEE 754 rounds in one way are used."""
    trial = run_trial(SMALL, 0)
    others = run_trial(SMALL, 1), run_trial(replace(SMALL, seed=8), 0)
    assert len({bits(trial), *map(bits, others)}) == 3
    assert trial.seed == 3386250816931739734
    first = [x.hex() for x in trial.waypoints[0].tolist()]
    assert first == ["0x1.c55f991800000p+3", "0x1.31abf2fc00000p+4"]


def trial_of(number, waypoints):
    return Trial(
        trial=number, seed=0, length=-1.0, waypoints=np.array(waypoints, float),
        collision_free=True, seconds=0.0,
    )  # fmt: skip


ONE_DISC = Planning((0, 0), (10, 0), [(5, 0)], 2.0)
FREE = [(2, 3), (8, 3)]
FREE_AND_LONG = [(2, 4), (8, 4)]
GRAZES = [(3, 1.5), (7, 1.5)]  # 0.5 deep, shorter than any free path
CROSSES = [(4, 0), (6, 0)]  # 2 deep, shortest


def test_the_shortest_free_path_wins_whatever_the_order():
    trials = [trial_of(n, w) for n, w in enumerate([CROSSES, FREE_AND_LONG, FREE, GRAZES, FREE])]
    for order in (trials, trials[::-1]):
        plan = best(order, ONE_DISC)
        assert (plan.trial, plan.trials, plan.collision_free) == (2, 5, True)
        assert plan.path.tolist() == [[0, 0], [2, 3], [8, 3], [10, 0]]
        assert plan.length == pytest.approx(6 + 2 * np.sqrt(13))
        assert plan.clearance == pytest.approx(1)
        assert plan.excess == pytest.approx(plan.length / plan.shortest_possible - 1)


def test_where_no_path_is_free_the_plan_says_so():
    plan = best([trial_of(0, CROSSES), trial_of(1, GRAZES)], ONE_DISC)
    assert (plan.trial, plan.collision_free) == (1, False)
    assert plan.clearance == pytest.approx(-0.5)
    with pytest.raises(LidarError, match="No planning trial was completed"):
        best([], ONE_DISC)


coordinate = st.floats(-50, 50)
point = st.tuples(coordinate, coordinate)


@given(first=point, last=point, center=point)
def test_distance_is_below_and_close_to_that_of_any_sample(first, last, center):
    share = np.linspace(0, 1, 401)[:, None]
    samples = np.array(first) * (1 - share) + np.array(last) * share
    sampled = np.hypot(*(samples - center).T).min()
    found = segment_distances(np.array([first]), np.array([last]), np.array([center]))[0, 0]
    spacing = math.dist(first, last) / 400
    assert found <= sampled + 1e-9
    assert found >= sampled - spacing / 2 - 1e-9


def test_a_disc_between_samples_is_not_missed():
    """A disc of a thousandth of the segment's length, that no coarse sampling would meet."""
    path = np.array([[0.0, 0], [1000.0, 0]])
    assert clearance(path, np.array([[333.3, 0.4]]), np.array([0.5])) == pytest.approx(-0.1)


BAD = {
    "start within": (
        {"centers": [(25, 24)], "radii": 2},
        r"start of the path \(25, 25\) lies within disc 0",
    ),
    "target within": ({"centers": [(0, 0), (-30, -21)], "radii": 2}, "target .* within disc 1"),
    "no way to go": ({"start": (1, 2), "target": (1, 2)}, "Move one of them"),
    "start not finite": (
        {"start": (np.nan, 0)},
        "start must be a list of 2 finite numbers, but is .nan, 0",
    ),
    "target in space": ({"target": (0, 0, 0)}, "target must be a list of 2 finite numbers"),
    "centers not finite": ({"centers": [(0, np.inf)], "radii": 1}, "centers` is .*inf"),
    "centers in space": ({"centers": [(0, 0, 0)], "radii": 1}, r"centers` is .*\(m, 2\)"),
    "radii too many": ({"centers": [(0, 0)], "radii": [1, 2]}, "one for each disc or one for all"),
    "radius below 0": ({"centers": [(0, 0)], "radii": -1}, "positive"),
    "radius not finite": (
        {"centers": [(0, 0)], "radii": np.inf},
        "radii` is inf; it must be positive fin",
    ),
    "no trials": ({"trials": 0}, "trials must be a whole number from 1 to"),
}


@pytest.mark.parametrize(("fields", "message"), BAD.values(), ids=BAD.keys())
def test_bad_values_are_named(fields, message):
    with pytest.raises(LidarError, match=message) as error:
        Planning(**fields)
    assert len(str(error.value).splitlines()) <= 2


# By symmetry twice the way to the origin, where the inner tangent crosses.
FAR = 10.0
NEAR = math.hypot(5, 3.5)
RADIUS = 4.0
ACROSS = 2 * (
    math.sqrt(FAR**2 - RADIUS**2)
    + math.sqrt(NEAR**2 - RADIUS**2)
    + RADIUS * (math.pi - math.atan2(3.5, 5) - math.acos(RADIUS / FAR) - math.acos(RADIUS / NEAR))
)


def over(rise: float, radius: float) -> float:
    """From (-5, 0) to (5, 0) over the top of a disc at (0, rise)."""
    apart = math.hypot(5, rise)
    bend = math.pi / 2 + math.atan2(rise, 5) - math.acos(radius / apart)
    return 2 * (math.sqrt(apart**2 - radius**2) + radius * bend)


# Each case has a start, a target, the centers of discs, their radii, and the length of the way.
CASES = {
    "no disc": ((0, 0), (3, 4), [], [], 5),
    "nowhere to go": ((1, 1), (1, 1), [], [], 0),
    "out of the way": ((0, 0), (10, 0), [(5, 3)], [2.9], 10),
    "just touched": ((0, 0), (10, 0), [(5, 3)], [3], 10),
    "a small one": ((-5, 0), (5, 0), [(0, 0)], [0.01], over(0, 0.01)),
    "one whose edge the ends touch": ((-5, 0), (5, 0), [(0, 0)], [5], 5 * math.pi),
    "over one and under the next": ((-15, -3.5), (15, 3.5), [(-5, -3.5), (5, 3.5)], [4, 4], ACROSS),
    "two that overlap": ((-5, 0), (5, 0), [(0, 1.5), (0, -1.5)], [2, 2], over(1.5, 2)),
    "a gap": ((-5, 0), (5, 0), [(0, 2.01), (0, -2.01)], [2, 2], 10),
    "the same twice": ((-5, 0), (5, 0), [(0, 0), (0, 0)], [2, 2], over(0, 2)),
    "one within another": ((-5, 0), (5, 0), [(0, 0), (0.9, 0)], [2, 1], over(0, 2)),
    "a small one on top": ((-5, 1), (5, 1), [(0, 0), (0, 2)], [2, 0.5], over(1, 0.5)),
    "the small one first": ((-5, 1), (5, 1), [(0, 2), (0, 0)], [0.5, 2], over(1, 0.5)),
    "an end within one": ((0, 0), (9, 0), [(0.5, 0)], [1], math.inf),
}


@pytest.mark.parametrize("name", CASES)
def test_lengths_by_formula(name):
    *given, expected = CASES[name]
    assert shortest_path_length(*given) == pytest.approx(expected, rel=1e-12)


def test_a_path_through_a_disc_costs_more_than_any_detour():
    """The boundaries of all discs together are longer than any path around them."""
    centers = np.array([[0.0, 2.0 * k] for k in range(20)])
    radii = np.full(20, 0.3)
    cost = PathCost(centers, radii, waypoints=1, particles=2)
    cost.waypoints[:, :, 0] = [[0.0, 0.0]]  # through the first disc
    cost.waypoints[:, :, 1] = [[0.0, -0.4]]  # around it
    through, around = cost.evaluate().tolist()
    assert around == pytest.approx(2 * math.hypot(0.5, 0.4), rel=1e-6)
    assert through > 2 * math.pi * radii.sum()


@pytest.mark.parametrize("enclosed", [(0, 0), (9, 9)])
def test_a_closed_ring_of_discs_has_no_way_out(enclosed):
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    ring = 3 * np.stack([np.cos(angles), np.sin(angles)], axis=1) + enclosed
    closed = np.full(8, 1.2)
    ajar = np.full(8, 1.1)
    assert shortest_path_length((0, 0), (9, 9), ring, closed) == math.inf
    assert 9 * math.sqrt(2) <= shortest_path_length((0, 0), (9, 9), ring, ajar) < 14


@pytest.mark.extended
def test_of_thousands_of_discs_those_out_of_reach_cost_nothing():
    """Looking at all of them would take an hour."""
    x, y = np.meshgrid(np.linspace(-50, 50, 60), np.linspace(6, 60, 50))
    grid = np.stack([x.ravel(), y.ravel()], axis=1)
    found = shortest_path_length((-5, 0), (5, 0), [*grid, (0, 0)], [*np.full(3000, 0.4), 2])
    assert found == pytest.approx(over(0, 2), rel=1e-12)
