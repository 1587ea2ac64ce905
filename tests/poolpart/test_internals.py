"""What is relied on in Dask: where it differs, poolpart steps aside, unnoticed by strangers."""

import inspect
import logging
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from distributed import Client, scheduler, worker_client
from tests.poolpart.helpers import LONG_S, here

import poolpart
from poolpart import Partition, Pool, PoolError, n_workers, rest

PACKAGE = Path(poolpart.__file__).parent

# Names that belong to the inside of Dask, or that its documentation does not mention.
INSIDE = (
    "extensions|handlers|in_flight|add_resources|used_resources|total_resources|worker_kwargs|"
    r"idle_task_count|valid_workers\b|future_refcount|stream_comms|http_application|"
    "transitions|stimulus|bulk_schedule|check_idle|run_spec|gather_from_workers|to_serialize"
)


def nested():
    with worker_client() as client:
        return client.gather(client.map(here, range(20), pure=False))


def test_nothing_else_reaches_into_dask():
    inside = re.compile(rf"\.(_state|_worker|_cluster)\b|\b({INSIDE})\b")
    for path in PACKAGE.glob("*.py"):  # those of `internals` are in a folder
        code = "".join(re.split(r'""".*?"""|#.*', path.read_text(), flags=re.DOTALL | re.M))
        ours = re.compile("valid_workers_downscaling")
        assert not inside.findall(ours.sub("", code)), path


def rename(monkeypatch, old, new, *methods):
    """Have methods of the scheduler written with another name, as a later Dask might."""
    for method in methods:
        owner = next(
            kind for kind in (scheduler.Scheduler, scheduler.SchedulerState) if method in vars(kind)
        )
        source = textwrap.dedent(inspect.getsource(vars(owner)[method]))
        assert old in source
        made = {}
        exec(re.sub(rf"\b{old}\b", new, source), vars(scheduler), made)
        monkeypatch.setattr(owner, method, made[method])


@pytest.fixture
def renamed_keyword(monkeypatch):
    """A Dask in which a keyword is called otherwise that inheritance goes by."""
    methods = ("_create_taskstate_from_graph", "update_graph", "_apply_annotations")
    rename(monkeypatch, "annotations_by_type", "notes_by_kind", *methods)


def test_a_renamed_keyword_does_not_reach_strangers(renamed_keyword, start, caplog):
    client = start({name: {} for name in "abc"})
    caplog.set_level(logging.WARNING)  # a cluster that is started silences it
    with Client(client.cluster) as stranger:
        parts = Pool.from_client(client).divide({"A": n_workers(1, exclusive=True), "B": rest()})
        assert stranger.submit(pow, 2, 10).result(LONG_S) == 1024
        outside = {worker.name for worker in parts["B"].workers}
        assert set(stranger.gather(stranger.map(here, range(20), pure=False))) == outside
        assert parts["A"].submit(here).result(LONG_S) not in outside
        assert outside.issuperset(stranger.submit(nested).result(LONG_S))
    # The owner is told what is missing.
    assert "tasks from inside tasks may run anywhere" in parts["A"].note
    assert "_create_taskstate_from_graph" in caplog.text
    Pool.from_client(client).dissolve()
    assert "_create_taskstate_from_graph" not in vars(client.cluster.scheduler)


def test_a_fence_that_cannot_be_raised_is_refused(monkeypatch, start):
    rename(monkeypatch, "ts", "task", "decide_worker_rootish_queuing_disabled")
    client = start({name: {} for name in "abc"})
    pool = Pool.from_client(client)
    with pytest.raises(PoolError, match=r"has no decide_worker_rootish_queuing_disabled\(ts\)"):
        pool.divide({"A": n_workers(1, exclusive=True), "B": rest()})
    assert client.submit(pow, 2, 10).result(LONG_S) == 1024
    parts = pool.divide({"A": n_workers(1), "B": rest()})
    assert parts["A"].submit(nested).result(LONG_S) == [parts["A"].workers[0].name] * 20


def test_what_fails_while_it_is_asked_does_not_reach_strangers(monkeypatch, start, caplog):
    """A rule that goes wrong after all, as where an attribute has another meaning."""
    client = start({name: {} for name in "abc"})
    caplog.set_level(logging.WARNING)  # a cluster that is started silences it
    Pool.from_client(client).divide({"A": n_workers(1, exclusive=True), "B": rest()})
    fences = client.cluster.scheduler.plugins["poolpart-fences"]
    monkeypatch.setattr(fences, "names", None)
    inheritance = client.cluster.scheduler.plugins["poolpart-inherit"]
    monkeypatch.setattr(inheritance, "names", None)
    assert client.gather(client.map(abs, range(50))) == list(range(50))
    assert Partition("A", client).submit(nested).result(LONG_S)
    told = [text for text in caplog.messages if text.startswith("A rule of poolpart for ")]
    assert 0 < len(told) == len(set(told)) <= 5


def test_it_is_imported_with_any_dask():
    lacking = "import distributed.shuffle._core as core; del core.barrier_key; import poolpart"
    subprocess.run([sys.executable, "-c", lacking], check=True, timeout=LONG_S)
