"""Long tasks whose worker leaves under them."""

from __future__ import annotations

import pytest
from distributed import Status

from poolpart import WorkerLeft, telling_departure


class ClosingWorker:
    """Stands in for the worker of a task."""

    status = Status.closing


def test_what_is_raised_while_a_worker_leaves_says_so(monkeypatch):
    monkeypatch.setattr("poolpart.departure.get_worker", ClosingWorker)
    message = r"the worker has left \(AttributeError: 'NoneType' object has no"
    with pytest.raises(WorkerLeft, match=message) as caught, telling_departure():
        None.queue_get  # noqa: B018 - what Dask does with a client that was closed
    assert caught.value.__cause__ is None


@pytest.mark.parametrize("status", [Status.running, Status.paused, Status.closing_gracefully])
def test_on_a_worker_that_stays_errors_are_what_they_are(monkeypatch, status):
    monkeypatch.setattr(ClosingWorker, "status", status)
    monkeypatch.setattr("poolpart.departure.get_worker", ClosingWorker)
    with pytest.raises(ZeroDivisionError), telling_departure():
        1 / 0  # noqa: B018


def test_where_there_is_no_worker_errors_are_what_they_are():
    with pytest.raises(ZeroDivisionError), telling_departure():
        1 / 0  # noqa: B018
