"""Loops that numba compiles; without it they are plain Python, a hundred times slower."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

try:
    from numba import njit
except ImportError:
    njit = None


def _keeps() -> bool:
    """Whether numba has a folder for compiled code; else each process compiles it in 5 s."""
    try:
        njit(cache=True)(_keeps)
    except (RuntimeError, TypeError):  # neither beside this file nor in the user's home; no numba
        return False
    return True


# Compiled when a module is imported, or loaded from numba's cache.
OPTIONS: dict[str, Any] = {"cache": _keeps(), "error_model": "numpy"}


def compiled(*signature: str) -> Callable[[Any], Any]:
    """Compile a function of a signature of numba's; without one when it is called first."""
    if njit is None:
        return lambda function: function
    made: Callable[[Any], Any] = njit(*signature, nogil=True, **OPTIONS)
    return made


def inlined(function: Any) -> Any:
    """Let a function become part of compiled ones."""
    return function if njit is None else njit(forceinline=True, error_model="numpy")(function)
