"""How much work a map keeps in flight."""

from types import SimpleNamespace

import pytest

from poolpart import map_lead
from poolpart.map_lead import LeadTime


@pytest.mark.parametrize(
    ("busy_s", "waited_s", "idle", "expected"),
    [
        ({"A": 0.5}, 5.0, 0.5, 2.0),  # both were idle for half of ten seconds
        ({"A": 0.5}, 5.0, 0.0, 1.0),  # the slots were busy with other tasks
        ({"A": 0.95}, 5.0, 0.5, 1.0),  # the slots were busy
        ({"A": 0.5}, 0.5, 0.5, 1.0),  # the client was busy
        ({"A": 0.1, "B": 0.95}, 9.0, 0.5, 1.0),  # the slots of the other partition were busy
    ],
)
def test_it_doubles_if_slots_and_client_are_idle(monkeypatch, busy_s, waited_s, idle, expected):
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(map_lead, "time", SimpleNamespace(monotonic=lambda: clock.now))
    lead = LeadTime()
    for _ in range(9):
        lead.count_task(busy_s)
    lead.count_wait(waited_s)
    clock.now += 10.0
    assert not lead.is_short(10)  # ten tasks have not come back yet
    lead.count_task(busy_s)
    if lead.is_short(10):
        lead.review(idle)
    assert lead.seconds == expected
    for _ in range(10):
        lead.count_task({"A": 1.0})
    lead.count_wait(9.0)
    clock.now += 10.0
    assert not lead.is_short(10)  # what was before does not count again
