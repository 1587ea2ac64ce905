"""Rows of parametrized tests."""

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def quick(chosen: Collection[Any], rows: Iterable[Any]) -> list[Any]:
    """Rows of a test, of which `make test` takes the `chosen`, and `make slow` the others."""
    slow = pytest.mark.slow
    return [row if row in chosen else pytest.param(row, marks=slow) for row in rows]
