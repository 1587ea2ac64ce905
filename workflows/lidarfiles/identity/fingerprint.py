"""Content fingerprints, which are only equal for values that lead to the same result.

The fingerprint of an object depends on its class and its fields. Classes and functions that are
defined outside lidarpool also contribute their code, so that a subclass with a modified method has
a different fingerprint. Fields declared with `dataclasses.field(compare=False)` are ignored.
"""

from __future__ import annotations

import dataclasses
import hashlib
import reprlib
import types
import weakref
from collections.abc import Mapping, Set
from datetime import datetime
from fractions import Fraction
from functools import cached_property, lru_cache, partial
from pathlib import PurePath
from typing import Any

import numpy as np

from lidarsim.errors import LidarError

# Code of these packages is identified by its version.
_OWN_PACKAGES = (
    "lidarfiles", "lidarlive", "lidarpool", "lidarreal", "lidarscenario", "lidarscenes", "lidarsim",
    "lidarview",
)  # fmt: skip
# Methods that dataclasses generate from the fields.
_GENERATED = {
    "__init__", "__repr__", "__eq__", "__hash__", "__lt__", "__le__", "__gt__", "__ge__",
    "__setattr__", "__delattr__", "__getstate__", "__setstate__", "__replace__",
}  # fmt: skip
_PLAIN = (bool, int, float, complex, str, bytes, Fraction, PurePath, type(None), type(Ellipsis))

# Types of class attributes that contribute to a fingerprint.
_CONSTANTS = (*_PLAIN, np.generic, np.ndarray, list, tuple, Mapping, Set, partial)
_CODE = (
    partial, types.FunctionType, types.MethodType, type, types.BuiltinFunctionType, np.ufunc,
    types.ModuleType,
)  # fmt: skip


def fingerprint(*values: Any) -> str:
    """Return the SHA-256 hash of the given values as hexadecimal text.

    Parameters
    ----------
    values
        Numbers, text, arrays, containers, dataclasses and functions, and any objects whose fields
        contain such values.

    Raises
    ------
    LidarError
        If a value cannot be hashed. The message names the value.

    Examples
    --------
    >>> fingerprint((1, 2.0)) == fingerprint((1, 2.0)), fingerprint(1) == fingerprint(1.0)
    (True, False)
    """
    digest = _Digest()
    for value in values:
        digest.add(value)
    return digest.hexdigest()


@lru_cache(1024)
def _hash_name(word: str) -> str:
    return fingerprint(word)


def _hash_key(key: Any) -> str:
    return _hash_name(key) if type(key) is str else fingerprint(key)


# {id of a read-only array: (array, hash)}. The jobs of a campaign share large scenes.
_hashes: dict[int, tuple[weakref.ref[Any], bytes]] = {}
_MIN_CACHED_BYTES = 1 << 16  # smaller arrays are hashed each time


def _hash_array(array: np.ndarray[Any, Any]) -> bytes:
    """Return the hash of an array's values, which is cached for large read-only arrays."""
    cached = _hashes.get(id(array))
    if cached is not None and cached[0]() is array:
        return cached[1]
    data = np.ascontiguousarray(array).view(np.uint8).data
    digest = hashlib.sha256(data).digest()
    # The arrays of a Scene are read-only.
    if array.nbytes >= _MIN_CACHED_BYTES and not array.flags.writeable:
        key = id(array)
        _hashes[key] = weakref.ref(array, lambda _: _hashes.pop(key, None)), digest
    return digest


class _Digest:
    """Hash that is computed from values of any supported type."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()
        self._open: list[int] = []  # ids of the values being added, to detect cycles

    def hexdigest(self) -> str:
        return self._hash.hexdigest()

    def _mark(self, *words: object) -> None:
        for word in words:
            data = str(word).encode()
            self._hash.update(b"%d:" % len(data) + data)

    def add(self, value: Any) -> None:
        """Add a value to the hash.

        A reference to an enclosing value is recorded as a cycle instead of being followed.
        """
        if id(value) in self._open:
            self._mark("circle")
            return
        self._open.append(id(value))
        try:
            self._add(value)
        finally:
            self._open.pop()

    def _add(self, value: Any) -> None:
        if isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, _PLAIN):
            # repr writes a float with enough digits to identify it.
            self._mark(type(value).__name__, repr(value))
        elif isinstance(value, datetime):
            self._mark("datetime", value.isoformat())
        elif isinstance(value, np.ndarray):
            if value.dtype.hasobject:
                raise _unhashable_error(value)
            self._mark("array", value.dtype.str, value.shape)
            self._hash.update(_hash_array(value))
        elif isinstance(value, (list, tuple, Mapping, Set)):
            self._add_container(value)
        elif isinstance(value, _CODE):
            self._add_code_object(value)
        else:
            self._add_object(value)

    def _add_container(self, container: Any) -> None:
        if isinstance(container, (list, tuple)):
            self._mark("sequence", len(container), *getattr(container, "_fields", ()))
            for item in container:
                self.add(item)
        elif isinstance(container, Mapping):
            self._mark("mapping", len(container))
            for key in sorted(container, key=_hash_key):
                self.add(key)
                self.add(container[key])
        else:
            self._mark("set")
            self.add(sorted(container, key=fingerprint))

    def _add_code_object(self, value: Any) -> None:
        if isinstance(value, partial):
            self.add((value.func, value.args, value.keywords))
        elif isinstance(value, types.FunctionType):
            self._add_function(value)
        elif isinstance(value, types.MethodType):
            self.add((value.__func__, value.__self__))
        elif isinstance(value, type):
            self._add_class(value)
        elif isinstance(value, types.ModuleType):
            self._mark("module", value.__name__)  # the content of the module is ignored
        else:
            self._mark("builtin", getattr(value, "__module__", ""), value.__name__)

    def _add_object(self, instance: Any) -> None:
        cls = type(instance)
        declared_fields = dataclasses.fields(instance) if dataclasses.is_dataclass(instance) else ()
        state = {field.name: getattr(instance, field.name) for field in declared_fields}
        attributes = getattr(instance, "__dict__", None)
        if attributes is None and not state:
            raise _unhashable_error(instance)
        state |= {k: v for k, v in (attributes or {}).items() if not _is_cached(cls, k)}
        ignored = {field.name for field in declared_fields if not field.compare}
        self._add_class(cls)
        self.add({name: value for name, value in state.items() if name not in ignored})

    def _add_class(self, kind: type) -> None:
        self._mark("class", kind.__module__, kind.__qualname__)
        for base in kind.__mro__:
            root = base.__module__.partition(".")[0]
            if (
                base is object
                or root in _OWN_PACKAGES
                or base.__module__ in ("builtins", "typing", "abc")
            ):
                continue
            for name, value in sorted(vars(base).items()):
                function = getattr(value, "fget", None) or getattr(value, "func", None) or value
                function = getattr(function, "__func__", function)
                special = name.startswith("__")
                if isinstance(function, types.FunctionType):
                    # Protocols add special methods from `typing` to their subclasses.
                    is_defined = not special or function.__module__ == base.__module__
                    counts = is_defined and name not in _GENERATED
                else:
                    counts = not special and isinstance(value, _CONSTANTS)
                if counts:
                    self._mark(name)
                    self.add(function)

    def _add_function(self, function: types.FunctionType) -> None:
        self._mark("function", function.__module__, function.__qualname__)
        if (function.__module__ or "").partition(".")[0] in _OWN_PACKAGES:
            return
        self._add_code(function.__code__)
        self.add((function.__defaults__, function.__kwdefaults__))
        for cell in function.__closure__ or ():
            self.add(cell.cell_contents)
        for name in _used_names(function.__code__):
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


def _used_names(code: types.CodeType) -> list[str]:
    """Return the sorted names of the globals and attributes that code uses.

    Nested code is included.
    """
    inner = [c for c in code.co_consts if isinstance(c, types.CodeType)]
    return sorted({*code.co_names, *(name for c in inner for name in _used_names(c))})


def _is_cached(kind: type, name: str) -> bool:
    return isinstance(getattr(kind, name, None), cached_property)


def _unhashable_error(value: Any) -> LidarError:
    return LidarError(
        f"{reprlib.repr(value)} of type {type(value).__name__} cannot be hashed, so runs that "
        "use it cannot be distinguished. Use only numbers, strings, arrays and dataclasses in "
        "sensor and column fields."
    )
