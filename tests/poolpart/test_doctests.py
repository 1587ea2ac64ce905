"""The examples in the docstrings."""

import doctest
import importlib
import pkgutil

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


def test_the_public_names_exist():
    assert sorted(poolpart.__all__) == poolpart.__all__
    assert all(hasattr(poolpart, name) for name in poolpart.__all__)
