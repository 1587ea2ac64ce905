import hashlib
import os
import pickle
import subprocess
import sys
import threading

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from lidarpool.base.errors import LidarpoolError
from lidarpool.plan import (
    Plan,
    Planning,
    Trial,
    best,
    run_trial,
    shortest_path_length,
)
from lidarpool.plan.geometry import clearance, path_length, segment_distances
from lidarpool.plan.randoms import Randoms, Windows

SEED_SCENE = [(-20, -20), (20, -20), (-20, 20), (20, 20), (-10, -5), (5, 5)]
DEFAULT = Planning((25, 25), (-30, -20), SEED_SCENE, 2.0)
SMALL = Planning((25, 25), (-30, -20), SEED_SCENE, 2.0, particles=60, iterations=40, seed=7)


def bits(trial):
    return trial.waypoints.tobytes() + bytes([trial.collision_free])


def fingerprint():
    """Of a few trials; run by this test in other processes too, so it imports nothing local."""
    return hashlib.sha256(b"".join(bits(run_trial(SMALL, n)) for n in range(3))).hexdigest()


# --- the default problem


def test_default_problem_for_many_seeds():
    shortest = shortest_path_length(DEFAULT.start, DEFAULT.target, DEFAULT.centres, DEFAULT.radii)
    for seed in range(4):
        planning = Planning(DEFAULT.start, DEFAULT.target, SEED_SCENE, 2.0, seed=seed)
        plan = best([run_trial(planning, number) for number in range(3)], planning)
        assert plan.collision_free
        assert plan.shortest_possible == shortest
        assert shortest <= plan.length <= 1.001 * shortest
        assert tuple(plan.path[0]) == (25, 25)
        assert tuple(plan.path[-1]) == (-30, -20)


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


def test_without_discs_the_path_is_straight():
    planning = Planning((0, 0), (3, 4), particles=100, iterations=200)
    plan = best([run_trial(planning, 0)], planning)
    assert plan.collision_free
    assert plan.clearance == np.inf
    assert plan.length == pytest.approx(5, rel=1e-5)


@pytest.mark.parametrize("particles", [1, 2, 19, 97, 100])
@pytest.mark.parametrize("waypoints", [1, 4])
def test_any_number_of_particles_runs(particles, waypoints):
    planning = Planning(
        centres=SEED_SCENE, radii=2, particles=particles, iterations=3, waypoints=waypoints
    )
    trial = run_trial(planning, 0)
    assert trial.waypoints.shape == (waypoints, 2)
    assert np.isfinite(trial.waypoints).all()


# --- what a trial says


def test_a_trial_says_what_it_found():
    trial = run_trial(SMALL, 4)
    path = np.vstack([SMALL.start, trial.waypoints, SMALL.target])
    assert trial.trial == 4
    assert trial.length == path_length(path)
    assert trial.collision_free == (clearance(path, SMALL.centres, SMALL.radii) >= 0)
    assert trial.seconds > 0
    assert len(pickle.dumps(trial)) < 2000


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


# --- the same seeds, the same bits


def test_trials_differ_and_repeat():
    trials = [run_trial(SMALL, number) for number in range(4)]
    assert len({trial.seed for trial in trials}) == 4
    assert len({bits(trial) for trial in trials}) == 4
    assert [bits(run_trial(SMALL, number)) for number in range(4)] == [bits(t) for t in trials]


def test_a_seed_changes_every_trial():
    other = Planning(
        SMALL.start, SMALL.target, SEED_SCENE, 2.0, particles=60, iterations=40, seed=8
    )
    assert bits(run_trial(other, 0)) != bits(run_trial(SMALL, 0))


def test_global_random_state_is_neither_read_nor_written():
    np.random.seed(1)  # noqa: NPY002
    before = pickle.dumps(np.random.get_state())  # noqa: NPY002
    first = bits(run_trial(SMALL, 0))
    assert pickle.dumps(np.random.get_state()) == before  # noqa: NPY002
    np.random.seed(2)  # noqa: NPY002
    assert bits(run_trial(SMALL, 0)) == first


def test_trials_side_by_side_in_threads_do_not_meet():
    alone = [bits(run_trial(SMALL, number)) for number in range(6)]
    together = [b""] * 6

    def work(number):
        together[number] = bits(run_trial(pickle.loads(pickle.dumps(SMALL)), number))

    threads = [threading.Thread(target=work, args=(number,)) for number in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert together == alone


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
    assert trial.seed == 3386250816931739734
    first = [x.hex() for x in trial.waypoints[0].tolist()]
    assert first == ["0x1.c55f991800000p+3", "0x1.31abf2fc00000p+4"]


# --- random numbers


def test_uniform_numbers():
    numbers = Randoms(5).uniform(100_000)
    assert numbers.dtype == np.float32
    assert numbers.min() >= 0
    assert numbers.max() < 1
    assert numbers.mean() == pytest.approx(0.5, abs=0.005)
    assert numbers.var() == pytest.approx(1 / 12, rel=0.02)


def test_normal_numbers():
    numbers = Randoms(5).normal(100_000)
    assert numbers.dtype == np.float32
    assert abs(numbers).max() < 3.5
    assert numbers.mean() == pytest.approx(0, abs=0.02)
    assert numbers.var() == pytest.approx(1, rel=0.02)
    # The fourth moment of four uniform numbers: 3 - 1.2 / 4; a uniform one's is 1.8.
    assert (numbers.astype(float) ** 4).mean() == pytest.approx(2.7, abs=0.05)


def test_windows_lie_in_the_table_and_reach_both_its_ends():
    table = np.arange(13, dtype=np.float32)
    windows = Windows(table, 10, Randoms(1))
    starts = set()
    for _ in range(200):
        window = windows.draw()
        assert np.array_equal(window, np.arange(window[0], window[0] + 10))
        starts.add(int(window[0]))
    assert starts == {0, 1, 2, 3}


# --- the best of the trials


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
        assert isinstance(plan, Plan)
        assert plan.trial == 2
        assert plan.trials == 5
        assert plan.collision_free
        assert plan.path.tolist() == [[0, 0], [2, 3], [8, 3], [10, 0]]
        assert plan.length == pytest.approx(6 + 2 * np.sqrt(13))
        assert plan.clearance == pytest.approx(
            (segment_distances(plan.path[:-1], plan.path[1:], np.array([[5, 0]])) - 2).min()
        )
        assert plan.excess == pytest.approx(plan.length / plan.shortest_possible - 1)
        assert plan.excess > 0


def test_trials_are_not_taken_at_their_word():
    """`collision_free` and `length` of a trial are worked out again."""
    plan = best([trial_of(0, CROSSES), trial_of(1, FREE)], ONE_DISC)
    assert plan.trial == 1


def test_where_no_path_is_free_the_plan_says_so():
    plan = best([trial_of(0, CROSSES), trial_of(1, GRAZES)], ONE_DISC)
    assert plan.trial == 1
    assert not plan.collision_free
    assert plan.clearance == pytest.approx(-0.5)


def test_an_enclosed_start_ends_in_an_honest_plan():
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    ring = 3 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    planning = Planning((0, 0), (9, 9), ring, 1.3, particles=50, iterations=20)
    plan = best([run_trial(planning, number) for number in range(2)], planning)
    assert not plan.collision_free
    assert plan.clearance < 0
    assert plan.shortest_possible == np.inf
    assert np.isfinite(plan.path).all()


def test_no_trials_is_an_error():
    with pytest.raises(LidarpoolError, match="No planning trial was finished"):
        best([], ONE_DISC)


# --- the benchmark


def test_the_benchmark_runs(capsys):
    from benchmarks import planning as benchmark

    options = "--repeats 2 --particles 40 --iterations 5 --discs 0 6 8 --waypoints 2"
    benchmark.main(options.split())
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4
    assert lines[0].split()[:2] == ["discs", "waypoints"]
    assert [line.split()[0] for line in lines[1:]] == ["0", "6", "8"]
    assert all(float(line.split()[4]) > 0 for line in lines[1:])
