"""Two hundred workers: nothing is misplaced, whichever way it was submitted."""

import pytest
from distributed import get_worker

from poolpart import Pool

NAMES = ("A", "B", "C", "D")


def here(_=None):
    return str(get_worker().name)


@pytest.fixture
def two_hundred(start):
    """Client of a cluster of 200 workers, all threads of this process."""
    return start({f"worker-{number}": {} for number in range(200)})


@pytest.mark.slow
def test_twenty_thousand_tasks_in_four_partitions_of_two_hundred_workers(two_hundred):
    rest, parts = Pool.from_client(two_hundred), []
    for name in NAMES:
        part, rest = rest.partition(name, n_workers=50)
        parts.append(part)
    assert len(rest) == 0
    members = [{worker.name for worker in part.workers} for part in parts]
    assert sum(map(len, members)) == len(set.union(*members)) == 200
    futures = [part.submit_many(here, range(4500)) for part in parts]
    ran = [two_hundred.gather(tasks) for tasks in futures]
    ran = [names + list(part.map(here, range(500))) for part, names in zip(parts, ran, strict=True)]
    assert sum(map(len, ran)) == 20_000
    for names, own in zip(ran, members, strict=True):
        assert set(names) <= own
        assert len(set(names)) > 25  # not all on a few
