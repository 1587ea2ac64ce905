import hashlib
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from lidarpool.base.errors import LidarpoolError
from lidarpool.plan import Planning, Trial, best, run_trial, shortest_path_length
from lidarpool.plan.geometry import clearance, segment_distances

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


@settings(max_examples=8, derandomize=True)
@given(discs=scene)
def test_random_scenes(discs):
    array = np.array(discs, float)
    centres, radii = array[:, :2], array[:, 2]
    ends = np.array([DEFAULT.start, DEFAULT.target])
    assume((segment_distances(ends, ends, centres) > radii + 0.1).all())
    planning = Planning(DEFAULT.start, DEFAULT.target, centres, radii)
    shortest = shortest_path_length(planning.start, planning.target, centres, radii)
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
        centres=SEED_SCENE, radii=2, particles=particles, iterations=3, waypoints=waypoints
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
        rooms.append(clearance(path, planning.centres, planning.radii))
        assert trial.collision_free == (rooms[-1] >= 0)
    assert max(rooms) > 0
    assert any(-0.5 < room < 0 for room in rooms)


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
    with pytest.raises(LidarpoolError, match="No planning trial was finished"):
        best([], ONE_DISC)
