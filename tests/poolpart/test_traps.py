"""Traps of Dask: each is sprung first by Dask's own means, then by ours, which do not suffer.

Those that have their tests elsewhere are listed in docs/pool-partitions/dask-internals.md. Where
one of these fails in its first half, Dask has got better, and something here may be left out.
"""

import time

from tests.poolpart.helpers import LONG_S, addresses, kill

from poolpart import Partition, Pool


def slowly(number: int) -> int:
    time.sleep(0.1)
    return number


def test_a_resource_that_is_set_wakes_no_task_and_a_partition_does(start, wait_until):
    client = start({"a": {}, "b": {}})
    scheduler = client.cluster.scheduler
    by_hand = client.submit(slowly, 1, resources={"HAND": 1})
    waiting = Partition("P", client).submit(slowly, 1)
    wait_until(lambda: len(scheduler.unrunnable) == 2)

    async def declare(dask_worker=None):
        await dask_worker.set_resources(HAND=1)

    client.run(declare, workers=[addresses(client)["a"]])
    assert client.submit(slowly, 2, resources={"HAND": 1}).result(LONG_S) == 2  # a later one runs
    assert scheduler.tasks[by_hand.key].state == "no-worker"

    Pool.from_client(client).partition("P", workers=["b"])
    assert waiting.result(LONG_S) == 1
    assert scheduler.tasks[by_hand.key].state == "no-worker"
    Pool.from_client(client).partition("HAND", workers=["a"])
    assert by_hand.result(LONG_S) == 1


def test_a_task_for_a_worker_by_name_waits_for_its_old_address_and_one_for_a_partition_runs(
    nannies, wait_until
):
    partition, _ = Pool.from_client(nannies).partition("P", workers=["1"])
    tied = nannies.submit(slowly, 1, workers=["1"], pure=False)
    members = [partition.submit(slowly, number) for number in range(3)]
    killed = kill(nannies, "1")
    wait_until(lambda: addresses(nannies).get("1", killed) != killed)
    assert nannies.gather(members) == [0, 1, 2]
    # A task that had the time to end is gone with its worker, and is to be computed again.
    assert nannies.cluster.scheduler.tasks[tied.key].state == "no-worker"
