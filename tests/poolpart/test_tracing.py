from __future__ import annotations

from collections.abc import Iterator

import pytest

from poolpart import trace, trace_to


@pytest.fixture(autouse=True)
def _quiet_afterwards() -> Iterator[None]:
    yield
    trace_to(None)


def test_points_reach_the_sink_with_their_fields() -> None:
    seen = []
    trace_to(lambda point, fields: seen.append((point, dict(fields))))

    trace("collect.put", scans=(3, 7))

    assert seen == [("collect.put", {"scans": (3, 7)})]


def test_nobody_hears_once_the_sink_is_taken_away() -> None:
    seen: list[str] = []
    trace_to(lambda point, _: seen.append(point))
    trace_to(None)

    trace("collect.put")

    assert seen == []


def test_what_the_sink_raises_reaches_the_one_that_passes() -> None:
    def refuse(point: str, _: object) -> None:
        raise RuntimeError(point)

    trace_to(refuse)

    with pytest.raises(RuntimeError, match=r"sort\.get"):
        trace("sort.get")
