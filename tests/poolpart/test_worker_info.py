from poolpart import WorkerInfo


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
