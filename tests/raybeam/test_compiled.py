"""Loops are compiled once, and again when a file that they depend on has changed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from raybeam import compiled

pytest.importorskip("numba")

LOOP = """
from raybeam.compiled import compiled
from .numbers import MORE

@compiled("f8(f8)")
def more(x):
    return x + MORE

if __name__ == "__main__":
    print(more(1.0), len(more.stats.cache_misses))
"""


@pytest.fixture
def package(tmp_path):
    """A package with a loop that depends on a number of another file, read through a third."""
    package = tmp_path / "loops"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "more.py").write_text(LOOP)
    (package / "numbers.py").write_text("from .constants import MORE\n")
    (package / "constants.py").write_text("MORE = 2.0\n")
    return package


def start(package):
    """Run the loop in a process, which prints what it adds and how often it compiled."""
    path = {**os.environ, "PYTHONPATH": str(Path(compiled.__file__).parents[1])}
    return subprocess.Popen(
        [sys.executable, "-m", "loops.more"],
        cwd=package.parent, env=path, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip


def printed(process):
    return process.communicate()[0].split()


@pytest.mark.extended
def test_only_a_change_of_imported_files_compiles_again(package):
    """A loop depends on what its file imports, also indirectly, and not on all of its package.

    What a loop takes from there is a constant of its code, of which numba knows nothing.
    """
    assert printed(start(package)) == ["3.0", "1"]
    (package / "unrelated.py").write_text("LESS = 1.0\n")
    assert printed(start(package)) == ["3.0", "0"]
    (package / "constants.py").write_text("MORE = 30.0\n")
    assert printed(start(package)) == ["31.0", "1"]


@pytest.mark.extended
def test_processes_that_start_together_compile_once(package):
    """The others wait, and load what the first has kept."""
    started = [start(package) for _ in range(4)]
    assert sorted(map(printed, started)) == [["3.0", "0"]] * 3 + [["3.0", "1"]]


def test_an_inner_function_is_compiled_once_for_all_whole_numbers():
    """Numba would compile it for 0, and again for what the loop counts."""

    @compiled.stage
    def more(number):
        return number + 1

    @compiled.compiled()
    def count(to):
        number = 0
        while number < to:
            number = more(number)
        return number

    assert count(3) == 3 and len(more.overloads) == 1
