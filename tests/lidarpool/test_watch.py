"""Partitions whose workers stay away, or take no tasks."""

from types import SimpleNamespace

import pytest

from lidarpool.run.cluster import watch
from lidarpool.run.cluster.watch import Watch
from lidarsim import LidarError
from poolpart.task_locations import PartitionSnapshot


@pytest.fixture
def look(monkeypatch):
    """Looks at workers, given as partition and status, so many seconds after the first look."""
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(watch, "time", SimpleNamespace(monotonic=lambda: 1000.0 + clock.now))
    told: list[str] = []
    watching = Watch(None, ["GPU", "OTHER"], lasting=["LIDAR"], report=told.append)

    def look(seconds, *workers):
        identities = {
            str(number): {
                "name": f"w{number}",
                "resources": {name: 1.0},
                "status": status,
                "memory_limit": 150 * 2**20,
            }
            for number, (name, status) in enumerate(workers)
        }
        monkeypatch.setattr(watch, "worker_identities", lambda client: identities)
        there = PartitionSnapshot(queued_jobs=look.coming)
        monkeypatch.setattr(watch, "take_snapshot", lambda client, name: there)
        clock.now = seconds
        watching.check()

    look.watching = watching
    look.told = told
    look.coming = 0
    look(0)
    return look


ALL = [("GPU", "running"), ("OTHER", "running"), ("LIDAR", "running")]


def test_a_partition_may_be_empty_for_a_while(look):
    look(2, *ALL)
    look(60, *ALL[:2])
    assert look.told == ["waiting for workers of partition LIDAR for up to 2 s more"]
    look(63, *ALL)
    look(120, *ALL[1:])
    assert look.told[1:] == ["waiting for workers of partition GPU for up to 3 s more"]
    with pytest.raises(LidarError, match=r"'GPU' has had no workers for 60 s.*\"GPU=1\""):
        look(124, *ALL[1:])


def test_workers_that_are_paused_take_no_tasks(look):
    paused = [("GPU", "paused"), *ALL[1:]]
    look(59, *paused)
    with pytest.raises(LidarError, match=r"'GPU' have accepted no tasks for 60 s.*--memory-limit"):
        look(61, *paused)


def test_one_that_is_not_paused_will_do_and_the_other_is_named_once(look):
    look(30, ("GPU", "paused"), *ALL)
    look(61, ("GPU", "paused"), *ALL)
    [note] = look.watching.notes
    assert look.told == [note]
    assert (
        "paused worker w0 of partition GPU, because its memory is nearly full (limit: 150.00 MiB)"
        in note
    )


def test_what_runs_already_goes_on_where_workers_are_paused(look):
    look(61, *ALL[:2], ("LIDAR", "paused"))
    assert (look.told, look.watching.notes) == ([], [])
    with pytest.raises(LidarError, match="'LIDAR' has had no workers for 60 s"):
        look(122, *ALL[:2])  # its workers count only as long as they are there


def test_a_partition_with_nothing_left_to_do_may_leave(look):
    look.watching.remove_partitions(["OTHER"])
    look(61, ALL[0], ALL[2])
    assert look.told == []
    with pytest.raises(LidarError, match="'GPU' has had no workers for 60 s"):
        look(122, ALL[2])  # the others are watched as before
