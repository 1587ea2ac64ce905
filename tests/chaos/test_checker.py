"""Test the checker alone, using made-up logs."""

import pytest
from tests.chaos.checker import judge


def event(point, *scans, **fields):
    return {"point": point, "scans": list(scans), **fields}


def whole(scans=3):
    """Return the log of a run without defects."""
    numbers = range(scans)
    return [
        *(event("generate.put", scan) for scan in numbers),
        *(event("intersect.start", scan) for scan in numbers),
        *(event("driver.frame", scan) for scan in numbers),
        event("driver.points", *numbers),
        event("driver.release", *numbers),
    ]


ROWS = [0, 0, 1, 2, 2, 2]


def without(log, point):
    return [entry for entry in log if entry["point"] != point]


@pytest.mark.parametrize(
    ("log", "rows", "finding"),
    [
        (without(whole(), "driver.points"), ROWS, ("lost", "scan 0 (points)")),
        (whole(2), ROWS, ("lost", "scan 2 was never described")),
        (whole(), ROWS[1:], ("lost", "scan 0 (cloud: 1 of 2 rows)")),
        (whole(), [], ("lost", "scan 2 (cloud: 0 of 3 rows)")),
        ([*whole(), event("driver.frame", 2)], ROWS, ("duplicated", "scan 2 (frame)")),
        ([*whole(), event("driver.points", 0)], ROWS, ("duplicated", "scan 0 (points)")),
        (whole(), [*ROWS, 2], ("duplicated", "scan 2 (cloud: 4 rows for 3)")),
        ([*whole(), event("driver.frame", 3)], ROWS, ("unexpected", "scan 3 (frame, never asked")),
        (whole(), [*ROWS, 3], ("unexpected", "scan 3 (cloud: 1 rows of none)")),
        (whole(), [0, 1, 0, 2, 2, 2], ("unexpected", "scan 0 (cloud, out of order)")),
        (
            [*without(whole(), "driver.frame"), *(event("driver.frame", s) for s in (1, 0, 2))],
            ROWS,
            ("unexpected", "scan 0 (frame, out of order)"),
        ),
        (
            [event("driver.release", 1), *whole()],
            ROWS,
            ("unexpected", "scan 1 (released before it had arrived)"),
        ),
    ],
)
def test_what_it_finds(log, rows, finding):
    verdict = judge(log, 3, rows, ROWS)
    assert not verdict.sound
    what, scan = finding
    assert any(named.startswith(scan) for named in getattr(verdict, what)), verdict
    assert scan in str(verdict)


def test_what_was_tried_again_and_arrived_once_is_recovered():
    again = [event("intersect.start", 1), event("driver.handon", 2, stage="sort")]
    log = [*again, event("driver.handon", 2, stage="collect"), *whole()]
    verdict = judge(log, 3, ROWS, ROWS)
    assert verdict.sound
    assert verdict.recovered == (1,)  # scan 2 went to two stages, once to each


def test_what_was_tried_again_and_came_twice_is_not():
    log = [event("intersect.start", 1), *whole(), event("driver.points", 1)]
    assert judge(log, 3, ROWS, ROWS).recovered == ()
