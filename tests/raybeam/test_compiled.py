"""Loops are compiled once, and again when a file that they depend on has changed."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from raybeam import compiled

pytest.importorskip("numba")

LOOP = """
from .compiled import compiled
from .numbers import MORE

@compiled("f8(f8)")
def more(x):
    return x + MORE

if __name__ == "__main__":
    print(more(1.0), len(more.stats.cache_misses))
"""


@pytest.fixture
def run(tmp_path):
    """Run a loop of a package with another file that says a number: what it adds, and misses."""
    package = tmp_path / "loops"
    package.mkdir()
    shutil.copy(Path(compiled.__file__), package)
    (package / "__init__.py").touch()
    (package / "more.py").write_text(LOOP)

    def go(number=None):
        if number is not None:
            (package / "numbers.py").write_text(f"MORE = {number}\n")
        command = [sys.executable, "-m", "loops.more"]
        result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        return result.stdout.split()

    return go


def test_a_change_of_another_file_compiles_again(run):
    """What a loop takes from there is a constant of its code, of which numba knows nothing."""
    assert run("2.0") == ["3.0", "1"]
    assert run() == ["3.0", "0"]
    assert run("30.0") == ["31.0", "1"]


def test_only_a_change_of_imported_files_compiles_again(tmp_path):
    """A loop depends on what its file imports, also indirectly, and not on all of its package."""
    package = tmp_path / "loops"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "more.py").write_text(LOOP.replace("from .compiled", "from raybeam.compiled"))
    (package / "numbers.py").write_text("from .constants import MORE\n")

    def run():
        command = [sys.executable, "-m", "loops.more"]
        path = {**os.environ, "PYTHONPATH": str(Path(compiled.__file__).parents[1])}
        return subprocess.check_output(command, cwd=tmp_path, text=True, env=path).split()

    (package / "constants.py").write_text("MORE = 2.0\n")
    assert run() == ["3.0", "1"]
    (package / "unrelated.py").write_text("LESS = 1.0\n")
    assert run() == ["3.0", "0"]
    (package / "constants.py").write_text("MORE = 30.0\n")
    assert run() == ["31.0", "1"]


def test_processes_that_start_together_compile_once(run, tmp_path):
    """The others wait, and load what the first has kept."""
    (tmp_path / "loops/numbers.py").write_text("MORE = 2.0\n")
    command = [sys.executable, "-m", "loops.more"]
    started = [
        subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) for _ in range(8)
    ]
    printed = sorted(one.communicate()[0].split() for one in started)
    assert printed == [["3.0", "0"]] * 7 + [["3.0", "1"]]


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
