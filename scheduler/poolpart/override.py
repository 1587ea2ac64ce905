"""Overriding methods of a running scheduler, and taking that back; a leaf module.

Plugins of the scheduler hear of what happens; they have no say in what it decides. An
attribute of the instance hides the class's method until it is deleted.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import distributed

from .errors import PoolError

Method = Callable[..., Any]


class _Chain:
    """What stands in for a method: replacements, each of which gets the one before it."""

    def __init__(self, original: Method) -> None:
        self.original = self.method = original
        self.__name__ = original.__name__  # the server tells its log which handler it calls
        self.replacements: list[Method] = []

    def change(self, replacements: list[Method]) -> None:
        self.replacements, self.method = replacements, self.original
        for replacement in replacements:
            self.method = partial(replacement, self.method)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self.method(*args, **kwargs)


class Overrides:
    """Methods that somebody overrides; others may override the same ones."""

    def __init__(self) -> None:
        self._places: list[tuple[Any, str, Method]] = []

    def put(self, owner: Any, replacements: dict[str, Method]) -> None:
        """Have `replacement(original, …)` called instead of each method named.

        Raises
        ------
        PoolError
            If one of them is not there, in this version of Dask; then all is taken back.
        """
        if lacking := [method for method in replacements if not hasattr(owner, method)]:
            self.take_back()
            raise PoolError(
                f"{type(owner).__name__} of distributed {distributed.__version__} has no "
                f"{', '.join(lacking)}, which poolpart builds on: use a version that it asks for."
            )
        for name, replacement in replacements.items():
            chain = vars(owner).get(name)
            if not isinstance(chain, _Chain):
                chain = _Chain(getattr(owner, name))
                setattr(owner, name, chain)
            chain.change([*chain.replacements, replacement])
            self._places.append((owner, name, replacement))

    def take_back(self) -> None:
        """Have the methods without these replacements."""
        while self._places:
            owner, name, replacement = self._places.pop()
            chain = vars(owner)[name]
            chain.change([other for other in chain.replacements if other != replacement])
            if not chain.replacements:
                delattr(owner, name)
