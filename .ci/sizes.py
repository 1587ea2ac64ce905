"""Checks sizes: lines of each room, of classes and functions, and names that are defined twice.

`.ci/sizes.toml` holds the most lines of each room, and the reasons for what is larger or defined
more than once. Prints each room's lines beside its figure; exits with 1 if anything is above.
"""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
SOURCES = ("kernels", "scheduler", "workflows")
FREE = ("kernels/raybeam", "workflows/lidarpool/simulator")  # of limits of classes and functions
CLASS_LINES, METHODS, CODE_LINES, PARAMETERS = 400, 25, 60, 8
Function = ast.FunctionDef | ast.AsyncFunctionDef


def lines_of(room: str, endings: tuple[str, ...] = (".py", ".cu", ".js")) -> int:
    """Lines of a folder's own source files; minified ones are other people's."""
    files = [path for path in sorted((ROOT / room).rglob("*")) if path.suffix in endings]
    return sum(len(path.read_bytes().splitlines()) for path in files if ".min." not in path.name)


def code_lines(node: Function, text: list[str]) -> int:
    """Lines of a function's body without its docstring, comments and blank lines."""
    body = node.body[1:] if ast.get_docstring(node) else node.body
    if not body or node.end_lineno is None:
        return 0
    lines = (line.strip() for line in text[body[0].lineno - 1 : node.end_lineno])
    return sum(bool(line) and not line.startswith("#") for line in lines)


def large(path: str, tree: ast.Module, text: list[str]) -> Iterator[tuple[str, str]]:
    """Yield names of classes and functions that are too large, and in what."""
    for outer in ast.walk(tree):
        for node in ast.iter_child_nodes(outer):
            where = f"{outer.name}." if isinstance(outer, ast.ClassDef) else ""
            if isinstance(node, ast.ClassDef):
                lines = (node.end_lineno or 0) - node.lineno + 1
                methods = sum(isinstance(one, Function) for one in node.body)
                if lines > CLASS_LINES:
                    yield f"{path}:{where}{node.name}", f"a class of {lines} lines"
                elif methods > METHODS:
                    yield f"{path}:{where}{node.name}", f"a class of {methods} methods"
            elif isinstance(node, Function):
                lines, arguments = code_lines(node, text), node.args
                given = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
                count = sum(one.arg not in ("self", "cls") for one in given)
                if lines > CODE_LINES:
                    yield f"{path}:{where}{node.name}", f"a function of {lines} lines of code"
                elif count > PARAMETERS:
                    yield f"{path}:{where}{node.name}", f"a function of {count} parameters"


def defined(tree: ast.Module) -> Iterator[str]:
    """Yield the names of classes and type aliases of a module."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            name = node.targets[0].id
            is_type = isinstance(node.value, ast.Subscript | ast.BinOp | ast.Name | ast.Attribute)
            if is_type and re.match("_?[A-Z]", name) and not name.isupper():
                yield name


def main() -> int:
    """Print what is above, and return 1 if there is any."""
    known = tomllib.loads((ROOT / ".ci/sizes.toml").read_text("utf-8"))
    wrong: list[str] = []
    for room, most in known["lines"].items():
        lines = lines_of(room)
        print(f"{room:<36}{lines:>8,}{most:>8,}")
        if lines > most:
            wrong.append(f"{room} has {lines:,} lines, {lines - most:,} above its figure")
    product = sum(lines_of(root, (".py",)) for root in SOURCES)
    print(f"{'product, .py':<36}{product:>8,}{known['product']:>8,}")
    if product > known["product"]:
        wrong.append(f"the product has {product:,} lines of Python, {known['product']:,} at most")
    found: dict[str, str] = {}
    names: dict[str, list[str]] = defaultdict(list)
    for path in (path for root in SOURCES for path in sorted((ROOT / root).rglob("*.py"))):
        text, short = path.read_text("utf-8"), path.relative_to(ROOT).as_posix()
        tree = ast.parse(text)
        if not short.startswith(FREE):
            found |= large(short, tree, text.splitlines())
        if not path.stem.startswith("__"):
            names[f"module {path.stem}"].append(short)
        for name in {*defined(tree)}:
            names[name].append(short)
    reasons, twice = known["reasons"], known["same_names"]
    wrong += [f"{name} is {size}" for name, size in found.items() if name not in reasons]
    wrong += [
        f"{name} is not too large any more: drop its reason" for name in reasons.keys() - found
    ]
    several = {name: files for name, files in names.items() if len(files) > 1}
    wrong += [
        f"{name} is defined in {', '.join(files)}: give one of them another name"
        for name, files in several.items()
        if name not in twice
    ]
    wrong += [f"{name} is defined once: drop its reason" for name in twice.keys() - several]
    for line in wrong:
        print(f"sizes: {line}", file=sys.stderr)
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
