"""The examples in the docstrings, and the names that the README has."""

import doctest
import importlib
import pkgutil
import re
from pathlib import Path

import pytest

import poolpart

MODULES = [
    module.name
    for package in (poolpart, poolpart.extras)
    for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}.")
]


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings(name):
    assert doctest.testmod(importlib.import_module(name)).failed == 0


def test_the_readme_orders_all_modules_and_says_who_asks_for_each_extra():
    package = Path(poolpart.__file__).parent
    text = (package.parent / "README.md").read_text(encoding="utf-8")
    core, extras = text.partition("## The source")[2].split("## Extras")
    for table, column, folder in ((core, 2, package), (extras, 1, package / "extras")):
        rows = [line.split("|") for line in table.splitlines() if line.startswith("|")][2:]
        modules = re.findall(r"`(\w+)`", " ".join(row[column] for row in rows))
        assert sorted(modules) == sorted(
            path.stem for path in folder.glob("*.py") if not path.stem.startswith("_")
        )


def test_the_public_names_exist():
    assert sorted(poolpart.__all__) == poolpart.__all__
    assert all(hasattr(poolpart, name) for name in poolpart.__all__)
