"""Fingerprints of what things contain: two that have the same one give the same result.

What a thing is follows from its class and its fields, and of classes and functions that are not
ours also from their code, so that a subclass with another method is another thing.
"""

from __future__ import annotations

import dataclasses
import hashlib
import reprlib
import types
from collections.abc import Mapping, Set
from fractions import Fraction
from functools import cached_property, partial
from pathlib import PurePath
from typing import Any

import numpy as np

from .errors import LidarpoolError

_OURS = "lidarpool"  # versions tell our code apart
# What dataclasses write: it follows from the fields.
_WRITTEN = {
    "__init__", "__repr__", "__eq__", "__hash__", "__lt__", "__le__", "__gt__", "__ge__",
    "__setattr__", "__delattr__", "__getstate__", "__setstate__", "__replace__",
}  # fmt: skip
_PLAIN = (bool, int, float, complex, str, bytes, Fraction, PurePath, type(None), type(Ellipsis))

_CONSTANTS = (*_PLAIN, np.generic, np.ndarray, list, tuple, Mapping, Set, partial)  # of a class


def fingerprint(*things: Any) -> str:
    """SHA-256 of what some things contain, in hexadecimal.

    Parameters
    ----------
    things
        Numbers, text, arrays, containers, dataclasses, functions, and objects whose fields are
        such things.

    Raises
    ------
    LidarpoolError
        If something is of a kind that has no fingerprint, naming it.

    Examples
    --------
    >>> fingerprint((1, 2.0)) == fingerprint((1, 2.0)), fingerprint(1) == fingerprint(1.0)
    (True, False)
    """
    digest = _Digest()
    for thing in things:
        digest.add(thing)
    return digest.hexdigest()


class _Digest:
    """A hash that things are added to."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()
        self._open: list[int] = []  # ids of what is being added: a circle ends

    def hexdigest(self) -> str:
        return self._hash.hexdigest()

    def _mark(self, *words: object) -> None:
        for word in words:
            data = str(word).encode()
            self._hash.update(b"%d:" % len(data) + data)

    def add(self, thing: Any) -> None:
        """Add one thing."""
        if id(thing) in self._open:
            self._mark("circle")
            return
        self._open.append(id(thing))
        try:
            self._add(thing)
        finally:
            self._open.pop()

    def _add(self, thing: Any) -> None:
        if isinstance(thing, np.generic):
            thing = thing.item()
        if isinstance(thing, _PLAIN):
            # repr writes each float with as many digits as tell it from its neighbours.
            self._mark(type(thing).__name__, repr(thing))
        elif isinstance(thing, np.ndarray):
            if thing.dtype.hasobject:
                raise _refusal(thing)
            self._mark("array", thing.dtype.str, thing.shape)
            self._hash.update(np.ascontiguousarray(thing).view(np.uint8).data)
        elif isinstance(thing, (list, tuple)):
            self._mark("sequence", len(thing), *getattr(thing, "_fields", ()))
            for item in thing:
                self.add(item)
        elif isinstance(thing, Mapping):
            self._mark("mapping", len(thing))
            for key in sorted(thing, key=repr):
                self.add(key)
                self.add(thing[key])
        elif isinstance(thing, Set):
            self._mark("set")
            self.add(sorted(thing, key=repr))
        elif isinstance(thing, partial):
            self.add((thing.func, thing.args, thing.keywords))
        elif isinstance(thing, types.FunctionType):
            self._add_function(thing)
        elif isinstance(thing, types.MethodType):
            self.add((thing.__func__, thing.__self__))
        elif isinstance(thing, type):
            self._add_class(thing)
        elif isinstance(thing, (types.BuiltinFunctionType, np.ufunc)):
            self._mark("builtin", getattr(thing, "__module__", ""), thing.__name__)
        elif isinstance(thing, types.ModuleType):
            self._mark("module", thing.__name__)  # what is in it is not looked at
        else:
            self._add_object(thing)

    def _add_object(self, thing: Any) -> None:
        kind = type(thing)
        if dataclasses.is_dataclass(thing):
            state = {f.name: getattr(thing, f.name) for f in dataclasses.fields(thing)}
        else:
            state = {}
        own = getattr(thing, "__dict__", None)
        if own is None and not state:
            raise _refusal(thing)
        state |= {k: v for k, v in (own or {}).items() if not _is_cached(kind, k)}
        self._add_class(kind)
        self.add(state)

    def _add_class(self, kind: type) -> None:
        self._mark("class", kind.__module__, kind.__qualname__)
        for base in kind.__mro__:
            root = base.__module__.partition(".")[0]
            if base is object or root == _OURS or base.__module__ in ("builtins", "typing", "abc"):
                continue
            for name, value in sorted(vars(base).items()):
                function = getattr(value, "fget", None) or getattr(value, "func", None) or value
                function = getattr(function, "__func__", function)
                special = name.startswith("__")
                if isinstance(function, types.FunctionType):
                    # Protocols put hooks of typing's into the classes that follow them.
                    own = not special or function.__module__ == base.__module__
                    counts = own and name not in _WRITTEN
                else:
                    counts = not special and isinstance(value, _CONSTANTS)
                if counts:
                    self._mark(name)
                    self.add(function)

    def _add_function(self, function: types.FunctionType) -> None:
        self._mark("function", function.__module__, function.__qualname__)
        if (function.__module__ or "").partition(".")[0] == _OURS:
            return
        self._add_code(function.__code__)
        self.add((function.__defaults__, function.__kwdefaults__))
        for cell in function.__closure__ or ():
            self.add(cell.cell_contents)
        for name in _names(function.__code__):
            if name in function.__globals__:
                self._mark(name)
                self.add(function.__globals__[name])

    def _add_code(self, code: types.CodeType) -> None:
        self._mark("code", code.co_code.hex(), code.co_names, code.co_varnames)
        for constant in code.co_consts:
            if isinstance(constant, types.CodeType):
                self._add_code(constant)
            elif isinstance(constant, frozenset):
                self.add(sorted(constant, key=repr))
            else:
                self.add(constant)


def _names(code: types.CodeType) -> list[str]:
    """Names that code looks up, with those of the code within it."""
    inner = [c for c in code.co_consts if isinstance(c, types.CodeType)]
    return sorted({*code.co_names, *(name for c in inner for name in _names(c))})


def _is_cached(kind: type, name: str) -> bool:
    """Whether a field is one that a cached property has left: it follows from the others."""
    return isinstance(getattr(kind, name, None), cached_property)


def _refusal(thing: Any) -> LidarpoolError:
    return LidarpoolError(
        f"{reprlib.repr(thing)} of type {type(thing).__name__} has no fingerprint, so that a run "
        "with it could not be told from another: keep numbers, text, arrays or dataclasses in the "
        "fields of sensors and columns."
    )
