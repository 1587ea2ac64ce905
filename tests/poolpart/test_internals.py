"""What is relied on in Dask: where it differs, poolpart steps aside, unnoticed by strangers."""

import inspect
import logging
import re
import subprocess
import sys
import textwrap
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
from distributed import Client, scheduler, worker_client
from tests.poolpart.helpers import LONG_S, worker_name

import poolpart
from poolpart import Partition, Pool, PoolError, n_workers, rest
from poolpart.internals import names

PACKAGE = Path(poolpart.__file__).parent

# Names that belong to the inside of Dask, or that its documentation does not mention.
INSIDE = (
    "extensions|handlers|in_flight|add_resources|used_resources|total_resources|worker_kwargs|"
    r"idle_task_count|valid_workers\b|future_refcount|stream_comms|http_application|"
    "transitions|stimulus|bulk_schedule|check_idle|run_spec|gather_from_workers|to_serialize"
)


@pytest.fixture(autouse=True)
def _look_names_up_again():
    """Have names looked up anew: tests change Dask, or the list."""
    names.missing_names.cache_clear()
    yield
    names.missing_names.cache_clear()


def nested():
    with worker_client() as client:
        return client.gather(client.map(worker_name, range(20), pure=False))


def test_nothing_else_reaches_into_dask():
    inside = re.compile(rf"\.(_state|_worker|_cluster)\b|\b({INSIDE})\b")
    for path in (*PACKAGE.glob("*.py"), *PACKAGE.glob("extras/*.py")):
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
        assert set(stranger.gather(stranger.map(worker_name, range(20), pure=False))) == outside
        assert parts["A"].submit(worker_name).result(LONG_S) not in outside
        assert outside.issuperset(stranger.submit(nested).result(LONG_S))
    # The owner is told what is missing.
    assert "Tasks that other tasks submit may run on any worker" in parts["A"].note
    assert "_create_taskstate_from_graph" in caplog.text
    Pool.from_client(client).dissolve()
    assert "_create_taskstate_from_graph" not in vars(client.cluster.scheduler)


def test_a_fence_that_cannot_be_raised_is_refused(monkeypatch, start):
    rename(monkeypatch, "ts", "task", "decide_worker_rootish_queuing_disabled")
    client = start({name: {} for name in "abc"})
    pool = Pool.from_client(client)
    with pytest.raises(
        PoolError,
        match=r"has no .*rootish_queuing_disabled\(ts\), which poolpart requires for exclu",
    ):
        pool.divide({"A": n_workers(1, exclusive=True), "B": rest()})
    assert client.submit(pow, 2, 10).result(LONG_S) == 1024
    parts = pool.divide({"A": n_workers(1), "B": rest()})
    assert parts["A"].submit(nested).result(LONG_S) == [parts["A"].workers[0].name] * 20


def test_what_fails_while_it_is_asked_does_not_reach_strangers(
    monkeypatch, start, caplog, caught_errors
):
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
    told = [text for text in caplog.messages if text.startswith("The poolpart rule for ")]
    assert 0 < len(told) == len(set(told)) <= 5
    caught_errors.clear()


@pytest.mark.extended
def test_it_is_imported_with_any_dask():
    lacking = "import distributed.shuffle._core as core; del core.barrier_key; import poolpart"
    subprocess.run([sys.executable, "-c", lacking], check=True, timeout=LONG_S)


# -- private names of Dask that are missing ------------------------------------------------------


@pytest.mark.parametrize("row", names.PRIVATE_NAMES, ids=lambda row: row.purpose)
def test_this_version_has_all_private_names(row):
    assert names.missing_names(row.feature) == ()


def without(name, program):
    """Run a program in a process whose Dask lacks a private name; returns what it prints."""
    module, _, path = name.partition(":")
    owner, _, attribute = path.rpartition(".")
    lacking = f"""
        import importlib, sys, warnings
        warnings.simplefilter("ignore")
        module = importlib.import_module({module!r})
        delattr(module{f".{owner}" if owner else ""}, {attribute!r})
        from distributed import Client
        from tests.clusters import cluster_of
        import poolpart
        from poolpart import Partition, Pool, PoolError, n_workers, rest
        from tests.poolpart.helpers import worker_name
        with cluster_of({{"a": {{}}, "b": {{}}}}, {{"protocol": "inproc://"}}) as cluster:
            with Client(cluster) as client:
                pool = Pool.from_client(client)
    """
    source = textwrap.dedent(lacking) + textwrap.indent(textwrap.dedent(program), " " * 8)
    command = [sys.executable, "-c", source]
    root = Path(__file__).parents[2]
    result = subprocess.run(
        command, capture_output=True, text=True, timeout=LONG_S, cwd=root, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


DIVIDE = """
try:
    parts = pool.divide({"A": n_workers(1), "B": rest()})
    print(parts["A"].note)
    print(parts["A"].submit(pow, 2, 10).result(60))
    print(list(parts["A"].map(abs, [-1, -2])))
except PoolError as error:
    print("refused:", error)
"""


@pytest.mark.extended
def test_without_what_division_needs_it_is_refused_at_once():
    printed = without("distributed.worker_state_machine:WorkerState.all_running_tasks", DIVIDE)
    assert re.match(
        r"refused: distributed .* has no WorkerState.all_running_tasks, which poolpart requires "
        r"for dividing a pool\.",
        printed,
    )


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(
    "name",
    [
        "distributed.worker_state_machine:UnpauseEvent",
        "distributed.client:Future._traceback",
        "distributed.client:Future._exception",
    ],
)
def test_without_what_nested_tasks_need_partitions_work_and_say_so(name):
    note, *rest = without(name, DIVIDE).splitlines()
    assert note.startswith("Tasks that other tasks submit may run on any worker. distributed ")
    assert (
        f"has no {name.partition(':')[2]}, which poolpart requires for keeping nested tasks" in note
    )
    assert rest == ["1024", "[1, 2]"]


def test_the_rest_works_where_a_feature_is_off(start, monkeypatch):
    gone = [
        replace(row, names=("distributed.client:Future._gone",))
        if row.feature == names.MAP
        else row
        for row in names.PRIVATE_NAMES
    ]
    monkeypatch.setattr(names, "PRIVATE_NAMES", tuple(gone))
    part = Pool.from_client(start({"a": {}})).divide({"A": rest()})["A"]
    with pytest.raises(
        PoolError,
        match=r"has no Future\._gone, which poolpart requires for Partition\.map\. Install",
    ):
        part.map(abs, [1])
    assert part.submit(worker_name).result(LONG_S) == "a"


def test_an_untested_version_is_warned_about(monkeypatch):
    monkeypatch.setattr("distributed.__version__", "2031.10.0")
    names.warn_if_untested.cache_clear()
    with pytest.warns(
        UserWarning, match=r"tested with distributed .* installed version is 2031\.10\.0"
    ):
        names.require_feature(names.MAP)
    monkeypatch.setattr("distributed.__version__", f"{names.TESTED[1]}+3.gabcdef")
    names.warn_if_untested.cache_clear()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        names.require_feature(names.MAP)


def test_the_documentation_lists_the_private_names():
    page = (Path(__file__).parents[2] / "docs/pool-partitions/dask-internals.md").read_text("utf-8")
    for row in names.PRIVATE_NAMES:
        assert names.table_row(row) in page
