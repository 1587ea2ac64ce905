from collections import Counter

from hypothesis import given, settings
from hypothesis import strategies as st

from poolpart import WorkerInfo, assign_devices


def worker(name, *gpus, host="h", **resources):
    return WorkerInfo(name, f"tcp://{name}", host, 1, gpus=gpus, resources=resources)


def test_plain_workers_that_list_the_same_devices_spread():
    workers = [worker(name, "x", "y") for name in "abcd"]
    assert assign_devices(workers) == {"a": 0, "b": 1, "c": 0, "d": 1}


def test_rotated_lists_all_use_their_first():
    workers = [worker("a", "x", "y", "z"), worker("b", "y", "z", "x"), worker("c", "z", "x", "y")]
    assert assign_devices(workers) == {"a": 0, "b": 0, "c": 0}


def test_a_single_visible_device_is_number_0():
    assert assign_devices([worker("a", "x"), worker("b", "y")]) == {"a": 0, "b": 0}


def test_whoever_sees_one_device_chooses_before_whoever_sees_two():
    assert assign_devices([worker("two", "x", "y"), worker("one", "x")]) == {"one": 0, "two": 1}


def test_workers_without_devices_get_none():
    assert assign_devices([worker("a"), worker("b", "x")]) == {"b": 0}
    assert assign_devices([]) == {}


def test_hosts_do_not_disturb_each_other():
    workers = [worker("a", "x", "y"), worker("b", "u", "v", host="other")]
    assert assign_devices(workers) == {"a": 0, "b": 0}


@given(st.integers(1, 5), st.integers(1, 20), st.randoms(use_true_random=False))
@settings(deadline=None)
def test_devices_are_shared_evenly_whatever_the_order_of_the_lists(gpus, workers, random):
    lists = [random.sample(range(gpus), gpus) for _ in range(workers)]
    infos = [worker(str(i), *map(str, order)) for i, order in enumerate(lists)]
    ordinals = assign_devices(infos)
    used = Counter(info.gpus[ordinals[info.name]] for info in infos)
    assert sum(used.values()) == workers
    counts = [used[str(gpu)] for gpu in range(gpus)]
    assert max(counts) - min(counts) <= 1


def test_from_identity_takes_what_the_scheduler_says():
    identity = {
        "name": 3,
        "host": "h",
        "nthreads": 2,
        "memory_limit": None,
        "resources": {"GPU": 1, "gone": 0},
    }
    info = WorkerInfo.from_identity("tcp://h:1", identity)
    assert (info.name, info.memory, info.gpus) == ("3", 0, ())
    assert info.partitions == {"GPU"}
