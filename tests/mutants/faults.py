"""Faults for source files: replaced operators, comparisons, constants and conditions.

A fault replaces one expression on one line. Messages, assertions, log calls and representations are
left alone, since tests do not assert their wording.
"""

import ast
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

ROOTS = ("kernels", "scheduler", "workflows")
COMPILED = {"compiled", "inlined", "stage", "part"}  # decorators of loops that numba compiles

# Faults are planted in every module below `ROOTS` but these, so packages that are added later are
# included. `**` stands for any folders.
SKIPPED_MODULES = (
    # Layout of pictures, charts and pages: looked at, not asserted.
    "workflows/lidarview/**/*.py",
    "workflows/lidarpool/pages/*",
    "workflows/lidarpool/report/page/*",
    "workflows/**/*picture*.py",
    "workflows/**/*page*.py",
    "workflows/**/*charts*.py",
    "scheduler/poolpart/**/*page*.py",
    "scheduler/poolpart/html_table.py",
    "workflows/**/notebook.py",
    "scheduler/**/notebook.py",
    # Options of the command line, and the wording of messages.
    "workflows/lidarpool/cli/*",
    "workflows/lidarsim/errors.py",
    "workflows/lidarsim/words.py",
    "workflows/lidarsim/schema/error_sentences.py",
    "workflows/lidarsim/schema/field_advice.py",
    # Run on GPUs only.
    "kernels/raybeam/cuda_backend.py",
    "kernels/raybeam/device.py",
    "workflows/lidarsim/**/device_*.py",
)
_MESSAGE_CALLS = {"debug", "info", "warning", "error", "exception", "warn", "note", "echo", "about"}
_MESSAGE_FUNCTIONS = ("__repr__", "__str__", "_repr_html_")

_COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
_OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Div,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
_NAMES = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum"}


@dataclass(frozen=True)
class Fault:
    """Replacement of one expression.

    Attributes
    ----------
    path
        Source file, relative to the project's root.
    line
        Line number.
    columns
        First and last column of the expression, in bytes.
    function
        Qualified name of the function that contains it.
    before, after
        Text of the expression and of its replacement.
    compiled
        Whether numba compiles the function.
    """

    path: str
    line: int
    columns: tuple[int, int]
    function: str
    before: str
    after: str
    compiled: bool

    def __str__(self) -> str:
        return f"{self.path}:{self.line} in {self.function}: {self.before} -> {self.after}"

    @classmethod
    def read(cls, row: dict[str, Any]) -> "Fault":
        """Create a fault from a JSON object with its attributes."""
        return cls(**{**row, "columns": tuple(row["columns"])})

    def plant(self, source: str) -> str:
        """Plant the fault in a source text.

        Raises ValueError if the expression is not where it was.
        """
        lines = source.splitlines(keepends=True)
        line = lines[self.line - 1].encode() if self.line <= len(lines) else b""
        begin, end = self.columns
        if line[begin:end].decode() != self.before:
            raise ValueError(f"{self.path}:{self.line} has changed since the fault was chosen.")
        lines[self.line - 1] = (line[:begin] + f"({self.after})".encode() + line[end:]).decode()
        return "".join(lines)


def faults_in(root: Path, path: str) -> list[Fault]:
    """Return all faults that can be planted in a file."""
    source = (root / path).read_text()
    tree = ast.parse(source)
    lines = source.splitlines()
    found = []
    for function, compiled, node in _expressions(tree.body, "", compiled=False):
        for expression, after in _replacements(node):
            if expression.lineno != expression.end_lineno or expression.end_col_offset is None:
                continue
            begin, end = expression.col_offset, expression.end_col_offset
            before = lines[expression.lineno - 1].encode()[begin:end].decode()
            columns = (begin, end)
            found.append(Fault(path, expression.lineno, columns, function, before, after, compiled))
    return found


def modules(root: Path, packages: Sequence[str] = ROOTS) -> list[str]:
    """Return the source files in packages, by default in all, except `SKIPPED_MODULES`.

    Raises ValueError if a package does not exist.
    """
    missing = [package for package in packages if not (root / package).exists()]
    if missing:
        raise ValueError(f"There is no package or file {missing[0]!r}.")
    paths = {
        path.relative_to(root)
        for package in packages
        for path in (
            [root / package] if package.endswith(".py") else (root / package).rglob("*.py")
        )
    }
    return sorted(
        path.as_posix()
        for path in paths
        if not any(_matches(path, pattern) for pattern in SKIPPED_MODULES)
    )


def choose(root: Path, packages: Sequence[str], count: int, seed: int) -> list[Fault]:
    """Draw distinct faults at random from all that can be planted in packages."""
    every = [fault for path in modules(root, packages) for fault in faults_in(root, path)]
    random.Random(seed).shuffle(every)
    usable = (fault for fault in every if _can_be_parsed(fault, (root / fault.path).read_text()))
    return list(islice(usable, count))


def function_spans(source: str) -> dict[str, tuple[int, int]]:
    """Return the first and last line of each function's body, keyed by qualified name."""
    spans = {}
    waiting: list[tuple[str, ast.AST]] = [("", ast.parse(source))]
    while waiting:
        prefix, parent = waiting.pop()
        for node in ast.iter_child_nodes(parent):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                name = f"{prefix}{node.name}"
                if not isinstance(node, ast.ClassDef):
                    spans[name] = (node.body[0].lineno, node.end_lineno or node.lineno)
                waiting.append((f"{name}.", node))
            else:
                waiting.append((prefix, node))
    return spans


def _matches(path: Path, pattern: str) -> bool:
    """Return whether a path matches one of `SKIPPED_MODULES`."""
    if "**" not in pattern:
        return path.match(pattern)
    start, _, end = pattern.partition("/**/")
    return path.as_posix().startswith(f"{start}/") and path.match(end)


def _expressions(
    body: list[ast.stmt], prefix: str, *, compiled: bool
) -> Iterator[tuple[str, bool, ast.AST]]:
    """Yield all nodes in functions.

    Each node comes with the qualified name of its function, and whether the function is compiled.
    """
    for statement in body:
        if isinstance(statement, ast.ClassDef):
            yield from _expressions(statement.body, f"{prefix}{statement.name}.", compiled=False)
        elif isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef):
            if statement.name in _MESSAGE_FUNCTIONS:
                continue
            name = f"{prefix}{statement.name}"
            loop = compiled or any(_name(node) in COMPILED for node in statement.decorator_list)
            for inner in statement.body:
                for node in _walk(inner):
                    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                        yield from _expressions([node], f"{name}.", compiled=loop)
                    else:
                        yield name, loop, node


def _walk(node: ast.AST) -> Iterator[ast.AST]:
    """Yield a node and its descendants, except messages and the content of functions.

    The argument ``strict=True`` of zip is skipped, because it only checks the program itself.
    """
    if isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr | ast.AnnAssign):
        return
    if isinstance(node, ast.Call) and _name(node.func) in _MESSAGE_CALLS:
        return
    if isinstance(node, ast.keyword) and node.arg == "strict":
        return
    yield node
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return
    for child in ast.iter_child_nodes(node):
        yield from _walk(child)


def _name(node: ast.expr) -> str:
    """Return the unqualified name of a decorator or a called function, such as "warn"."""
    if isinstance(node, ast.Call):
        return _name(node.func)
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else ""


def _replacements(node: ast.AST) -> Iterator[tuple[ast.expr, str]]:
    """Yield replaceable expressions of a node, each with the text of a faulty replacement."""
    match node:
        case ast.Compare(left, [operator], [right]) if type(operator) in _COMPARISONS:
            faulty = ast.Compare(left, [_COMPARISONS[type(operator)]()], [right])
            yield node, ast.unparse(faulty)
        case ast.BinOp(left, operator, right) if type(operator) in _OPERATORS:
            if not _is_text(left) and not _is_text(right):
                yield node, ast.unparse(ast.BinOp(left, _OPERATORS[type(operator)](), right))
        case ast.BoolOp(operator, values):
            other = ast.Or() if isinstance(operator, ast.And) else ast.And()
            yield node, ast.unparse(ast.BoolOp(other, values))
        case ast.UnaryOp(ast.USub() | ast.Not(), operand):
            yield node, ast.unparse(operand)
        case ast.If(test) | ast.While(test) | ast.IfExp(test):
            yield test, f"not ({ast.unparse(test)})"
        case ast.Call(called):
            yield from _other_functions(called)
        case ast.Constant(value):
            yield from ((node, text) for text in _other_values(value))


def _other_functions(called: ast.expr) -> Iterator[tuple[ast.expr, str]]:
    """Yield a called function with the name of its replacement, such as `max` for `min`."""
    name = _name(called)
    if name in _NAMES and isinstance(called, ast.Name):
        yield called, _NAMES[name]
    elif name in _NAMES and isinstance(called, ast.Attribute):
        yield called, ast.unparse(ast.Attribute(called.value, _NAMES[name], ast.Load()))


def _other_values(value: object) -> Iterator[str]:
    """Yield the text of a different constant for a number or truth value."""
    if isinstance(value, bool):
        yield repr(not value)
    elif isinstance(value, int | float) and value not in (0, 1):
        yield repr(value + 1 if isinstance(value, int) else value * 1.1)


def _is_text(node: ast.expr) -> bool:
    """Return whether an operand is a string or a sum of strings."""
    if isinstance(node, ast.BinOp):
        return _is_text(node.left) or _is_text(node.right)
    return isinstance(node, ast.JoinedStr) or isinstance(getattr(node, "value", None), str)


def _can_be_parsed(fault: Fault, source: str) -> bool:
    """Return whether the source with a fault is valid Python.

    For example, `match` patterns cannot contain the parentheses that are inserted.
    """
    try:
        ast.parse(fault.plant(source))
    except SyntaxError:
        return False
    return True
