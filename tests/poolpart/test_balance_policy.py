"""The policy of balanced groups: by values, and in a simulation of 126 workers."""

import math
import random

import pytest
from tests.poolpart.pipeline_model import Cluster, Stage, count_by_stage

from poolpart.balance_policy import BalancePolicy, LoadSample, WorkerShift, divide_by_demand

# Two services of 0.17 and 0.21 s on 126 workers: at best 331.6 items/s, with 56.4 and 69.6 workers.
DECODE_S = 0.17
DETECT_S = 0.21
IDEAL = 126 / (DECODE_S + DETECT_S)
TRANSIENT_S = 20 * (DECODE_S + DETECT_S) / 2


def endless(_time):
    return math.inf


def about(seconds, rng):
    return lambda _: seconds * rng.uniform(0.7, 1.3)


def pipeline(decode=63, capacity=126, seed=0, **options):
    rng = random.Random(seed)
    return Cluster(
        Stage("DECODE", decode, about(DECODE_S, rng), 252, endless),
        Stage("DETECT", 126 - decode, about(DETECT_S, rng), capacity),
        **options,
    )


def test_workers_are_divided_in_proportion_to_the_demand():
    both = {"A": LoadSample(63), "B": LoadSample(63)}
    assert divide_by_demand(both, {"A": 17, "B": 21}) == {"A": 56, "B": 70}
    assert divide_by_demand(both, {"A": 0, "B": 3}) == {"A": 1, "B": 125}
    assert divide_by_demand(both, {"A": 0, "B": 0}) == {"A": 63, "B": 63}


def test_bounds_and_workers_that_cannot_be_moved_are_respected():
    samples = {
        "A": LoadSample(5, minimum=2),
        "B": LoadSample(5, maximum=6),
        "C": LoadSample(5, movable=1),
    }
    assert divide_by_demand(samples, {"A": 1, "B": 90, "C": 0}) == {"A": 5, "B": 6, "C": 4}
    assert divide_by_demand(samples, {"A": 0, "B": 90, "C": 9}) == {"A": 2, "B": 6, "C": 7}


def test_a_partition_that_lost_workers_gets_its_minimum_back():
    samples = {"A": LoadSample(0, minimum=2), "B": LoadSample(4)}
    assert divide_by_demand(samples, {"A": 0, "B": 4}) == {"A": 2, "B": 2}
    [shift] = BalancePolicy().update(samples, 0.5)
    assert shift == WorkerShift("B", "A", 1)


def test_slots_per_worker_count():
    samples = {"A": LoadSample(6, slots=2), "B": LoadSample(6)}
    assert divide_by_demand(samples, {"A": 8, "B": 8}) == {"A": 4, "B": 8}


def samples_at(tick, a, b):
    """Samples of two partitions, each given as (workers, slots, tasks per tick, waiting tasks)."""
    return {
        name: LoadSample(
            workers,
            slots=slots,
            finished=rate * tick,
            seconds=0.5 * rate * tick,
            backlog=workers * slots + waiting,
        )
        for name, (workers, slots, rate, waiting) in {"A": a, "B": b}.items()
    }


def test_tasks_in_the_slots_of_a_worker_do_not_wait():
    policy = BalancePolicy()
    for tick in range(40):
        assert policy.update(samples_at(tick, (2, 4, 8, 0), (8, 1, 8, 4)), 0.5) == []
    a, b = policy.demands["A"], policy.demands["B"]
    assert (a.rate, a.task_s, a.slots) == pytest.approx((16, 0.5, 8))
    assert (a.wait_s, b.wait_s) == pytest.approx((0, 4 / 16))
    # A tenth of the waiting time that causes the maximum surplus.
    assert b.slots == pytest.approx(8 * (1 + 0.1 * 0.25), rel=0.01)


def test_before_a_task_has_finished_the_demand_is_limited_by_the_slots():
    policy = BalancePolicy()
    samples = {"A": LoadSample(2, slots=4, backlog=100), "B": LoadSample(0, slots=3, backlog=100)}
    policy.update(samples, 0.5)
    assert [policy.demands[name].slots for name in "AB"] == pytest.approx([10, 3.75])
    policy.update({"A": LoadSample(2, slots=4, backlog=7), "B": LoadSample(1)}, 0.5)
    assert [policy.demands[name].slots for name in "AB"] == [7, 0]


def test_a_worker_moves_to_where_slots_are_missing_not_workers():
    policy = BalancePolicy()
    for tick in range(60):  # A has 3 workers of 4 slots for 8 tasks, and B 6 slots for 8 tasks
        shifts = policy.update(samples_at(tick, (3, 4, 8, 0), (6, 1, 8, 9)), 0.5)
    assert shifts == [WorkerShift("A", "B", 1)]


def test_the_time_for_which_averages_extend():
    """After 6 running times, the former rate still counts by 1/e."""
    policy = BalancePolicy()
    finished = 0
    for tick in range(200):
        finished += 5 if tick < 160 else 10
        policy.update({"A": LoadSample(5, finished=finished, seconds=1.0 * finished)}, 0.5)
        if tick == 171:  # 6 s later, with tasks of 1 s
            assert policy.demands["A"].rate == pytest.approx(20 - 10 / math.e, rel=0.02)
    assert policy.demands["A"].rate == pytest.approx(20, rel=0.05)


def test_three_partitions_exchange_workers_directly():
    policy = BalancePolicy()
    samples = {"A": LoadSample(4, backlog=0), "B": LoadSample(4), "C": LoadSample(4, backlog=50)}
    assert policy.update(samples, 0.5, moving=0) == [WorkerShift("A", "C", 1)]
    assert policy.update(samples, 0.5, moving=1) == []


def test_idle_partitions_exchange_no_workers():
    policy = BalancePolicy()
    for tick in range(20):
        samples = {
            name: LoadSample(8, finished=rate * tick, seconds=0.2 * rate * tick, backlog=2)
            for name, rate in {"A": 2, "B": 12}.items()
        }
        assert policy.update(samples, 0.5) == []
    assert policy.demands["B"].slots == pytest.approx(12 / 0.5 * 0.2, rel=0.2)


@pytest.mark.parametrize(
    ("task_s", "shifts"), [(0.01, [WorkerShift("A", "B", 1)]), (1.0, [])], ids=["many", "few"]
)
def test_a_small_gain_must_be_known_from_many_tasks(task_s, shifts):
    policy = BalancePolicy()
    for tick in range(60):
        samples = {
            name: LoadSample(
                10, finished=round(slots * 0.5 * tick / task_s), seconds=slots * 0.5 * tick
            )
            for name, slots in {"A": 9.0, "B": 10.5}.items()
        }
        found = policy.update(samples, 0.5)
        if found:
            break
    assert found == shifts


@pytest.mark.parametrize("decode", [3, 63, 110])
@pytest.mark.parametrize("capacity", [10, 126, 5000])
def test_a_pipeline_reaches_its_ideal_throughput(decode, capacity):
    cluster = pipeline(decode, capacity).run(30)
    assert cluster.throughput(TRANSIENT_S, 30) > 0.95 * IDEAL
    assert cluster.moved < 130


def test_a_fixed_division_in_halves_is_slower():
    assert pipeline(balanced=False).run(30).throughput(5, 30) < 0.92 * IDEAL


def test_an_endless_backlog_in_front_does_not_pile_up_results_behind():
    cluster = pipeline(capacity=math.inf).run(60)
    assert cluster.throughput(10, 60) > 0.95 * IDEAL
    assert cluster.stages["DETECT"].depth < 0.25 * IDEAL * 60


def test_a_change_of_running_times_is_followed():
    rng = random.Random(1)
    slow, fast = about(3 * DECODE_S, rng), about(DECODE_S, rng)
    cluster = Cluster(
        Stage("DECODE", 56, lambda time: (fast if time < 20 else slow)(time), 252, endless),
        Stage("DETECT", 70, about(DETECT_S, rng), 126),
    ).run(60)
    assert cluster.throughput(5, 20) > 0.95 * IDEAL
    ideal = 126 / (3 * DECODE_S + DETECT_S)
    assert cluster.throughput(20 + 20 * (3 * DECODE_S + DETECT_S) / 2, 60) > 0.95 * ideal


def test_bursts_that_alternate_are_finished_sooner_than_with_a_fixed_division():
    def bursts(first):
        return lambda time: min(6, int((time + first) // 20)) * 5000

    def run(balanced):
        rng = random.Random(2)
        return Cluster(
            Stage("A", 63, about(DECODE_S, rng), math.inf, bursts(20)),
            Stage("B", 63, about(DETECT_S, rng), math.inf, bursts(10)),
            chained=False,
            balanced=balanced,
        ).run(122)

    balanced, fixed = run(True), run(False)
    assert count_by_stage(balanced) == {"A": 30_000, "B": 30_000}
    assert len(fixed.done) < 60_000


def test_random_running_times_do_not_move_workers_back_and_forth():
    def run(balanced):
        rng = random.Random(3)
        return Cluster(
            Stage("DECODE", 4, lambda _: rng.expovariate(1 / DECODE_S), 16, endless),
            Stage("DETECT", 4, lambda _: rng.expovariate(1 / DETECT_S), 8),
            balanced=balanced,
        ).run(100)

    balanced = run(True)
    assert balanced.moved < 60  # less than one move per 30 tasks
    # No fixed division of eight workers is better than this one.
    assert balanced.throughput(5, 100) > 0.95 * run(False).throughput(5, 100)
