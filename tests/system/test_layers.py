"""What tests import: those of a package nothing from packages above it."""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TESTS = ROOT / "tests"


def _levels() -> dict[str, int]:
    """Level of each package, from the contract of import-linter."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = settings["tool"]["importlinter"]["contracts"]
    [rows] = [one["layers"] for one in contracts if one["name"].startswith("the packages:")]
    return {name: level for level, row in enumerate(reversed(rows)) for name in row.split(" | ")}


LEVELS = _levels()


def _imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _shared_module(name: str) -> Path | None:
    """File of a module in tests/ that defines what a test imports."""
    parts = name.split(".")
    paths = (ROOT.joinpath(*parts[:count]).with_suffix(".py") for count in (len(parts), -1))
    return next((path for path in paths if path.exists()), None)


@cache
def _packages(path: Path) -> frozenset[str]:
    """Packages that a test imports, also by what it shares with other tests."""
    found: set[str] = set()
    for name in _imports(path):
        top = name.partition(".")[0]
        if top == "tests":
            shared = _shared_module(name)
            assert shared is not None, f"{path} imports {name}"
            found |= _packages(shared)
        elif top in LEVELS:
            found.add(top)
    return frozenset(found)


@pytest.mark.parametrize("package", LEVELS)
def test_tests_import_nothing_from_above(package):
    own = LEVELS[package]
    files = sorted((TESTS / package).rglob("*.py"))
    assert files
    above = {
        f"{file.relative_to(TESTS)} imports {name}"
        for file in files
        for name in _packages(file)
        if LEVELS[name] > own or (LEVELS[name] == own and name != package)
    }
    assert above == set()
