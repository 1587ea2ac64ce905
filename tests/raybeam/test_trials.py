"""The fastest of several options is chosen by trials during the work."""

import sys
import time

import numpy as np
import pytest

from raybeam import Pattern, RayCaster, available_backends
from raybeam.trials import TRIALS, Alternation, Trials

windows = pytest.mark.skipif(
    sys.platform == "win32", reason="processor time advances in steps of 16 ms"
)


def chosen(seconds, options=("a", "b", "c")):
    """Trials that have chosen by the same times of the options."""
    trials = Trials(options)
    for _ in range(TRIALS):
        assert trials.due > 0
        trials.add(seconds)
    return trials


def test_the_option_with_the_smallest_median_is_chosen():
    trials = Trials(["a", "b", "c"])
    assert trials.current == "a"
    times = [(3, 2, 1), (3, 2, 9), (3, 1, 2), (1, 2, 3), (3, 2, 4)]
    for count, seconds in enumerate(times):
        assert (trials.current, trials.due) == ("a", TRIALS - count)
        trials.add(seconds)
    assert (trials.current, trials.due) == ("b", 0)


def test_a_single_option_needs_no_trial():
    trials = Trials(["a"])
    trials.worked(1e9)
    assert (trials.current, trials.due) == ("a", 0)


def test_a_clear_contradiction_makes_the_choice_anew():
    trials = chosen((3, 1, 2))
    trials.worked(1e6)
    assert trials.due == 1
    trials.add((3, 2, 1))  # other work
    assert trials.current == "b" and trials.due == TRIALS - 1
    for _ in range(TRIALS - 1):
        trials.add((3, 2, 1))
    assert (trials.current, trials.due) == ("c", 0)


def test_a_slight_contradiction_changes_nothing():
    trials = chosen((3, 1, 2))
    for _ in range(50):
        trials.worked(1e6)
        assert trials.due == 1
        trials.add((1.1, 1.2, 1.0))
        assert (trials.current, trials.due) == ("b", 0)


def test_a_single_disturbed_trial_leaves_the_choice():
    trials = chosen((3, 1, 2))
    trials.worked(1e6)
    trials.add((3, 9, 2))
    while trials.due:
        trials.add((3, 1, 2))
    assert trials.current == "b"


def test_trials_take_a_small_share_of_the_work():
    trials = chosen((3, 1, 2))
    tried = 0
    for piece in range(20_000):
        trials.worked(10.0)
        if trials.due:
            assert trials.due == 1
            trials.add((3, 1, 2), size=1.0)
            tried += 3
        if piece == 10:
            assert tried  # the first comes soon
    assert tried < 0.01 * 20_000 * 10


@windows
def test_processor_time_of_the_thread_counts(monkeypatch):
    now = {"elapsed": 0.0, "processor": 0.0}
    monkeypatch.setattr(time, "perf_counter", lambda: now["elapsed"])
    monkeypatch.setattr(time, "thread_time", lambda: now["processor"])

    def work(option):
        now["elapsed"] += {"waits": 9.0, "computes": 3.0}[option]
        now["processor"] += {"waits": 1.0, "computes": 3.0}[option]

    trials = Trials(["computes", "waits"])
    for _ in range(TRIALS):
        trials.try_all(work, 1.0)
    assert trials.current == "waits"


def test_calls_use_the_faster_option_also_after_times_have_changed():
    alternation = Alternation()
    seconds = [1.0, 2.0]
    taken = []
    for call in range(2_000):
        if call == 1_000:
            seconds = [2.0, 1.0]
        taken.append(alternation.next())
        alternation.add(taken[-1], seconds[taken[-1]])
    assert np.mean(taken[100:1_000]) < 0.05
    assert np.mean(taken[1_400:]) > 0.95


@windows
@pytest.mark.skipif(bool(available_backends()["embree"]), reason="Embree cannot be used here")
def test_scans_do_not_ask_for_the_elapsed_time(shapes, monkeypatch):
    azimuth, elevation = np.meshgrid(np.radians(np.arange(360)), np.radians(np.arange(-8, 8)))
    flat = np.cos(elevation)
    directions = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1)
    pattern = Pattern(directions.swapaxes(0, 1).reshape(-1, 3))
    caster = RayCaster(*shapes["sphere"](), "embree", threads=2)
    monkeypatch.setattr(time, "perf_counter", lambda: pytest.fail("the time that elapsed counts"))
    hits = {len(caster.scan(pattern, [0.05, 0.1, 0.4])) for _ in range(12)}
    monkeypatch.undo()
    assert hits == {len(pattern)}
