"""Readable signatures of functions and dataclasses whose annotations hold limits."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Callable
from typing import Any

_ANNOTATED = "Annotated["


class _Text(str):
    """Text of an annotation, which `inspect` shows without quotes."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


class _WithoutMetadata(ast.NodeTransformer):
    """Replaces ``Annotated[X, …]`` by ``X``."""

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        """Return the type of an `Annotated[…]` node, or the node itself."""
        self.generic_visit(node)
        annotated = isinstance(node.value, ast.Name) and node.value.id == "Annotated"
        return node.slice.elts[0] if annotated and isinstance(node.slice, ast.Tuple) else node


def readable(signature: inspect.Signature) -> inspect.Signature:
    """Return a signature whose annotations are types alone, without limits and descriptions.

    Examples
    --------
    >>> def scan(count: Annotated[int, Field(ge=1)], name: str | None = None): ...
    >>> readable(inspect.signature(scan))
    <Signature (count: int, name: str | None = None)>
    """
    parameters = [
        parameter.replace(annotation=_plain(parameter.annotation))
        for parameter in signature.parameters.values()
    ]
    return signature.replace(
        parameters=parameters, return_annotation=_plain(signature.return_annotation)
    )


def _plain(annotation: Any) -> Any:
    """Return an annotation without metadata, texts without quotes."""
    if not isinstance(annotation, str):
        return annotation
    if _ANNOTATED in annotation:
        annotation = ast.unparse(_WithoutMetadata().visit(ast.parse(annotation, mode="eval")))
    return _Text(annotation)


class ReadableSignature:
    """The attribute ``__signature__`` of a class: the signature of its ``__init__``, lazily."""

    def __get__(self, instance: object, owner: type) -> inspect.Signature:
        if instance is not None:
            raise AttributeError("__signature__")
        signature = inspect.signature(owner.__init__)  # type: ignore[misc]
        _, *parameters = signature.parameters.values()
        return readable(signature.replace(parameters=parameters)).replace(
            return_annotation=inspect.Signature.empty
        )


def annotated(function: Callable[..., Any]) -> bool:
    """Return True if an annotation of a function holds more than a type."""
    return any(_ANNOTATED in str(annotation) for annotation in function.__annotations__.values())
