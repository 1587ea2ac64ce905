"""Tasks of a partition one by one: those that wait and run, and the last that have ended."""

import threading
import time
from datetime import UTC, datetime, timedelta

import pytest
from distributed import wait
from tests.poolpart.helpers import LONG_S

from poolpart import Partition
from poolpart.task_table import MAX_ENDED_TASKS, TaskRow, TaskTable

CLUSTER = {"A-0": {"resources": {"A": 2}, "nthreads": 2}, "B-0": {"resources": {"B": 1}}}

go = threading.Event()  # the workers are threads of this process


def held(_):
    go.wait(LONG_S)


def after(*_):
    return 1


def broken(_):
    raise ValueError("two\nlines")


def test_a_slice_of_a_table_is_a_table():
    since = datetime(2026, 11, 29, tzinfo=UTC)
    table = TaskTable.from_rows(
        [TaskRow("done", f"t-{i}", "t", "A-0", 1) for i in range(5)] * 6, since
    )
    assert table[1] == table[1:2][0] == TaskRow("done", "t-1", "t", "A-0", 1)
    assert isinstance(table[2:4], TaskTable) and table[2:4].since == since
    assert [row.key for row in table[2:4]] == ["t-2", "t-3"]
    assert repr(table[:2]).splitlines()[1].split()[:3] == ["done", "t-0", "t"]
    assert "The first 20 of 30 tasks" in repr(table) and "The first" not in repr(table[:2])


@pytest.fixture
def part(start):
    go.clear()
    yield Partition("A", start(CLUSTER))
    go.set()


def test_tasks_that_wait_run_and_end(part, wait_until):
    assert part.tasks() == ()  # counting begins
    before = datetime.now(UTC)
    Partition("B", part.client).submit(after, 0).result(LONG_S)
    running = [part.submit(held, i, slots=1) for i in range(3)]
    last = part.submit(after, running, slots=2)
    wait_until(lambda: part.stats().waiting == 1 and part.stats().running == 2)
    rows = part.tasks()
    assert [row.state for row in rows] == ["waiting", "queued", "running", "running"]
    assert {row.key for row in rows[1:]} == {future.key for future in running}
    assert rows[1].key == running[2].key  # those that were submitted first run
    waiting = rows[0]
    assert (waiting.key, waiting.function, waiting.worker, waiting.slots) == (
        last.key, "after", "", 2
    )  # fmt: skip
    assert waiting.queued is None and {row.worker for row in rows[2:]} == {"A-0"}
    assert all(before < row.queued and row.finished is None for row in rows[1:])

    time.sleep(0.01)  # the running time is above this
    go.set()
    failed = part.submit(broken, 1)
    wait([last, failed], LONG_S)
    wait_until(lambda: len(part.tasks()) == 5 and not part.stats().running)
    rows = part.tasks()
    assert sorted(row.state for row in rows) == ["done"] * 4 + ["failed"]
    done = next(row for row in rows if row.key == running[0].key)
    # The scheduler notes when a task is queued, its worker when it starts. Dask estimates the
    # difference of their clocks to about a millisecond.
    slack = timedelta(milliseconds=50)
    assert before < done.queued <= done.started + slack
    assert done.started < done.finished < datetime.now(UTC) + slack
    assert 0.01 < done.seconds == (done.finished - done.started).total_seconds()
    (error,) = [row.error for row in rows if row.error]
    assert error == "ValueError('two\\nlines')"


def test_the_time_of_a_running_task(part, wait_until):
    before = datetime.now(UTC)
    running = part.submit(held, 0)
    wait_until(lambda: part.tasks() and part.tasks()[0].started is not None)
    (task,) = part.tasks()
    assert (task.key, task.state, task.finished) == (running.key, "running", None)
    slack = timedelta(milliseconds=50)
    assert before - slack < task.started < datetime.now(UTC)
    assert 0 < task.seconds <= (datetime.now(UTC) - before + slack).total_seconds()
    (later,) = part.tasks()
    assert later.seconds > task.seconds


@pytest.mark.extended
def test_only_the_last_that_have_ended_are_kept(part):
    part.tasks()
    futures = part.client.map(
        after, range(MAX_ENDED_TASKS + 5), resources={"A": 1}, key="many", batch_size=50
    )
    wait(futures, LONG_S)
    rows = part.tasks()
    assert len(rows) == MAX_ENDED_TASKS and {row.state for row in rows} == {"done"}


def test_the_table_is_printed_in_notebooks_and_as_a_frame(part):
    part.tasks()
    part.submit(broken, "<b>").exception(LONG_S)
    table = part.tasks()
    head, row = repr(table).splitlines()
    assert head.split() == [
        "state", "key", "function", "worker", "slots", "queued", "started", "seconds", "error"
    ]  # fmt: skip
    assert row.startswith("failed  broken-") and row.endswith("ValueError('two\\nlines')")
    page = table._repr_html_()
    assert "Tasks" in page and "failed" in page and "<b>" not in page
    frame = table.to_pandas()
    assert list(frame["state"]) == ["failed"] and frame["seconds"][0] >= 0


def test_a_long_table_is_printed_in_part(part):
    futures = part.client.map(after, range(30), resources={"A": 1}, key="many")
    table = part.tasks()
    wait(futures, LONG_S)
    part.client.gather([part.submit(after, i) for i in range(30)])
    table = part.tasks()
    *lines, last = repr(table).splitlines()
    assert len(table) >= 30 and len(lines) == 1 + 20
    assert (
        last
        == f"… The first 20 of {len(table)} tasks: {len(table)} done. `to_pandas()` returns all."
    )
    page = table._repr_html_()
    assert page.count("<tr>") == 1 + 20 and last in page


def test_the_keys_of_a_map_name_its_items(a):
    assert list(a.map(abs, range(-5, 0), chunk=2)) == [5, 4, 3, 2, 1]
    keys = {task.key for task in a.tasks() if task.function == "abs-map"}
    ends = ("-items-0-to-1", "-items-2-to-3", "-item-4")
    assert {end for end in ends for key in keys if key.endswith(end)} == {*ends}
