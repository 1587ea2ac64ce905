"""Readable signatures of functions and dataclasses: types without aliases, limits and quotes."""

from __future__ import annotations

import builtins
import inspect
import sys
from collections.abc import Callable, Collection, Mapping
from dataclasses import InitVar
from types import MappingProxyType, NoneType, UnionType
from typing import Annotated, Any, ForwardRef, Literal, TypeVar, Union, get_args, get_origin

import numpy as np

F = TypeVar("F", bound=Callable[..., Any])

_MAX_CHOICES = 60  # letters of the values of a Literal
# Unions of a dozen types, which a union with further types would hold one by one: a class instead.
_KEPT = {name: type(name, (), {}) for name in ("ArrayLike", "DTypeLike")}
_COMPUTED = "…"  # a default that is computed for each call


class _Text(str):
    """Text that `inspect` shows without quotes."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


class _Annotation(str):
    """An annotation as it is written, which `inspect` shows as the types that it stands for."""

    names: Mapping[str, Any]  # names in the modules of the annotation, which may still be imported
    is_optional: bool  # whether None is the default

    @classmethod
    def of(cls, annotation: Any, names: Mapping[str, Any], is_optional: bool = False) -> Any:
        """Return an annotation of source code, or an annotation that is not a text unchanged."""
        if not isinstance(annotation, str):
            return annotation
        written = cls(annotation)
        written.names = names
        written.is_optional = is_optional
        return written

    def __repr__(self) -> str:
        names = _Names({**self.names, **_KEPT})
        try:
            words = words_of(eval(self, {}, names))  # noqa: S307 - of our own source
        except (TypeError, AttributeError):
            words = str(self)
        return f"{words} | None" if self.is_optional and not _allows_none(words) else words


class _Names(dict[str, Any]):
    """Names of modules, with empty classes for names imported for type checkers only."""

    def __missing__(self, name: str) -> Any:
        return getattr(builtins, name, None) or type(name, (), {})


def _allows_none(words: str) -> bool:
    return words == "Any" or "None" in words.split(" | ")


def words_of(kind: Any) -> str:
    """Return a type as text, without limits, descriptions and names of modules.

    Examples
    --------
    >>> words_of(Annotated[int, "at least 1"] | None)
    'int | None'
    >>> words_of(Callable[[np.ndarray], tuple[str, ...]])
    'Callable[[ndarray], tuple[str, ...]]'
    """
    origin = get_origin(kind)
    args = get_args(kind)
    if kind in (None, NoneType):
        return "None"
    if isinstance(kind, InitVar):
        return words_of(kind.type)
    if origin is Annotated:
        return words_of(args[0])
    if origin in (Union, UnionType):
        return " | ".join(dict.fromkeys(map(words_of, args)))
    if origin is Literal:
        return _choices(args)
    if origin is np.ndarray:
        return _array(args)
    if isinstance(kind, (list, tuple)):
        return f"[{', '.join(map(words_of, kind))}]"
    if kind is Ellipsis:
        return "..."
    name = _name_of(origin or kind)
    return f"{name}[{', '.join(map(words_of, args))}]" if args else name


def _name_of(kind: Any) -> str:
    """Return the name of a class, of a type variable or of a type that is not imported."""
    if isinstance(kind, (ForwardRef, str)):
        return kind if isinstance(kind, str) else kind.__forward_arg__
    return getattr(kind, "__name__", None) or str(kind).rpartition(".")[2]


def _choices(values: tuple[Any, ...]) -> str:
    """Return the values of a Literal, or their types if they are long."""
    words = " | ".join(map(repr, values))
    if len(words) <= _MAX_CHOICES:
        return words
    return " | ".join(dict.fromkeys(type(value).__name__ for value in values))


def _array(args: tuple[Any, ...]) -> str:
    """Return the type of an array with its elements, if these are of one type."""
    (element,) = get_args(args[1]) or (Any,)
    return "NDArray" if element is Any else f"NDArray[{(get_origin(element) or element).__name__}]"


def readable(signature: inspect.Signature, names: Mapping[str, Any]) -> inspect.Signature:
    """Return a signature whose annotations are types alone, and whose defaults can be read.

    `names` are the names in the module of the annotations.

    Examples
    --------
    >>> Count = Annotated[int, "at least 1"]
    >>> def scan(count: Count, name: str | None = None) -> Count: ...
    >>> readable(inspect.signature(scan), globals() | locals())
    <Signature (count: int, name: str | None = None) -> int>
    """
    parameters = [
        parameter.replace(
            annotation=_Annotation.of(parameter.annotation, names, parameter.default is None),
            default=_shown(parameter.default),
        )
        for parameter in signature.parameters.values()
    ]
    result = _Annotation.of(signature.return_annotation, names)
    return signature.replace(parameters=parameters, return_annotation=result)


def shown_readably(function: F) -> F:
    """Give a function a readable signature."""
    signature = readable(inspect.signature(function), function.__globals__)
    function.__signature__ = signature  # type: ignore[attr-defined]
    return function


def with_fields_of(kind: type, without: Collection[str] = ()) -> Callable[[F], F]:
    """Let the readable signature of a function list the fields of a dataclass before `**options`.

    Fields of the names `without` are not listed.

    Examples
    --------
    >>> from dataclasses import make_dataclass
    >>> @with_fields_of(make_dataclass("Reading", [("unit", str, "m")], kw_only=True))
    ... def load(path: str, **options: Any) -> None: ...
    >>> inspect.signature(load)
    <Signature (path: str, *, unit: str = 'm', **options: Any) -> None>
    """

    def decorated(function: F) -> F:
        signature = readable(inspect.signature(function), function.__globals__)
        *parameters, options = signature.parameters.values()
        listed = inspect.signature(kind).parameters.values()
        fields = [parameter for parameter in listed if parameter.name not in without]
        function.__signature__ = signature.replace(  # type: ignore[attr-defined]
            parameters=[*parameters, *fields, options]
        )
        return function

    return decorated


def _shown(default: Any) -> Any:
    """Return a default, or its name if it is a function, which would be shown with its address."""
    if inspect.isroutine(default):
        return _Text(default.__name__)
    if isinstance(default, MappingProxyType):
        return dict(default)
    if type(default).__name__ == "_HAS_DEFAULT_FACTORY_CLASS":  # the mark of a dataclass
        return _Text(_COMPUTED)
    return default


class ReadableSignature:
    """The attribute ``__signature__`` of a class: the signature of its ``__init__``, lazily."""

    def __get__(self, instance: object, owner: type) -> inspect.Signature:
        if instance is not None:
            raise AttributeError("__signature__")
        signature = inspect.signature(owner.__init__)  # type: ignore[misc]
        _, *parameters = signature.parameters.values()
        public = [parameter for parameter in parameters if not parameter.name.startswith("_")]
        names: dict[str, Any] = {}
        for base in reversed(owner.__mro__):
            names |= vars(sys.modules[base.__module__])
        return readable(
            signature.replace(parameters=public, return_annotation=inspect.Signature.empty), names
        )
