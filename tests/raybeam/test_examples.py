"""The examples in docstrings say what happens."""

import doctest
import importlib

import pytest


@pytest.mark.parametrize("name", ["caster", "pattern", "registry", "scan"])
def test_examples(name):
    done = doctest.testmod(importlib.import_module(f"raybeam.{name}"))
    assert done.attempted > 0
    assert done.failed == 0
