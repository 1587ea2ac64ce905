"""What is said of tasks that failed."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from lidarpool.base.errors import LidarpoolError
from lidarpool.scan.failures import raise_if_failed


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (ValueError("too much"), "Stage sort failed: too much"),
        (TimeoutError(), "Stage sort failed: TimeoutError"),
    ],
)
def test_an_error_is_told_in_a_line(error, words):
    future = SimpleNamespace(
        status="error", exception=lambda timeout: error, traceback=lambda timeout: None
    )
    with pytest.raises(LidarpoolError) as told:
        raise_if_failed(future, "Stage sort")
    assert str(told.value) == words
    assert told.value.__cause__ is error
