"""Loops are compiled once, and again when a file that they depend on has changed."""

import importlib.util
import os
import pickle
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


def start(package, module="loops.more"):
    """Run the loop in a process, which prints what it adds and how often it compiled."""
    path = {**os.environ, "PYTHONPATH": str(Path(compiled.__file__).parents[1])}
    return subprocess.Popen(
        [sys.executable, "-m", module],
        cwd=package.parent, env=path, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip


def printed(process):
    return process.communicate()[0].split()


@pytest.mark.slow
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


def function_in(folder, monkeypatch, result="x - 2.0"):
    """Return a function of a new file, which has no compiled code yet."""
    path = folder / "less.py"
    path.write_text(f"def less(x):\n    return {result}\n")
    spec = importlib.util.spec_from_file_location("less", path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "less", module)  # compiled code imports its module
    spec.loader.exec_module(module)
    return module.less


@pytest.fixture
def function(package, monkeypatch):
    return function_in(package, monkeypatch)


def compilations(function):
    """Compile a function, or load its code; return how often numba compiled."""
    loop = compiled.compiled("f8(f8)")(function)
    assert loop(3.0) == 1.0
    return sum(loop.stats.cache_misses.values())


def file_of(package, kind):
    (file,) = (package / "__pycache__").glob(f"less.less-*.{kind}")
    return file


class Trap:
    """What somebody else may write into a file: unpickling it is an error."""

    def __reduce__(self):
        return pytest.fail, ("was unpickled",)


def cut(content):
    return content[: len(content) // 2]


def emptied(content):
    return b""


def flipped(content):
    at = len(content) // 2
    return content[:at] + bytes([content[at] ^ 4]) + content[at + 1 :]


def replaced(content):
    return pickle.dumps(Trap())


def notes(caplog):
    """What raybeam has logged; clients of earlier tests may log that they have lost a scheduler."""
    return [record.getMessage() for record in caplog.records if record.name.startswith("raybeam")]


@pytest.mark.extended
@pytest.mark.parametrize("damage", [cut, emptied, flipped, replaced])
@pytest.mark.parametrize("kind", ["nbi", "nbc"])
def test_a_damaged_loop_is_compiled_again_with_a_note(package, function, caplog, kind, damage):
    assert compilations(function) == 1
    file = file_of(package, kind)
    file.write_bytes(damage(file.read_bytes()))
    assert not notes(caplog)
    assert compilations(function) == 1
    assert notes(caplog) == [
        f"Compiled loops in {file.parent} are damaged and will be compiled again. The first one is "
        f"{file.name}."
    ]
    assert compilations(function) == 0  # what was compiled is kept


def test_what_a_killed_process_was_writing_is_removed(package, function):
    """A process that compiles removes it; files of others in that folder stay."""
    cache = package / "__pycache__"
    cache.mkdir(exist_ok=True)
    unfinished = [cache / "more.more-5.py311.nbi.tmp.0123", cache / "less.1.nbc.tmp.4567"]
    other = cache / "more.cpython-311.pyc.1234"
    for path in (*unfinished, other):
        path.write_bytes(b"begun")
    assert compilations(function) == 1
    assert not any(path.exists() for path in unfinished) and other.exists()


def test_code_of_an_earlier_version_of_a_loop_is_not_loaded(
    tmp_path, package, function, monkeypatch
):
    """A process that is killed between index and code of a changed loop leaves both versions.

    The index of numba itself would lead to the code of the earlier version.
    """
    assert compilations(function) == 1
    earlier = tmp_path / "earlier"
    earlier.mkdir()
    assert compilations(function_in(earlier, monkeypatch, "2.0 * x - 5.0")) == 1
    file_of(package, "nbc").write_bytes(file_of(earlier, "nbc").read_bytes())
    assert compilations(function) == 1


@pytest.mark.extended
def test_signatures_with_types_that_no_longer_exist_are_compiled_again(package):
    """As after an update that renames a named tuple."""
    loop = LOOP.partition("if __name__")[0]
    (package / "more.py").write_text(
        loop.replace('"f8(f8)"', "").replace("x + MORE", "x.one + MORE")
    )
    types = "from typing import NamedTuple\n\nclass Pair(NamedTuple):\n    one: float\n"
    types += "    two: float\n\nMORE = 2.0\n"
    call = "from loops.more import more\nfrom loops.numbers import Pair\n\n"
    call += "print(more(Pair(1.0, 2.0)), len(more.stats.cache_misses))\n"
    for name in ("Pair", "Two"):
        (package / "numbers.py").write_text(types.replace("Pair", name))
        (package / "__main__.py").write_text(call.replace("Pair", name))
        assert printed(start(package, "loops")) == ["3.0", "1"]
        assert printed(start(package, "loops")) == ["3.0", "0"]


def test_a_loop_that_cannot_be_kept_runs_with_a_note(package, function, caplog):
    """As on a full disk: a folder stands where the file of the code belongs."""
    assert compilations(function) == 1
    file = file_of(package, "nbc")
    file.unlink()
    file.mkdir()
    assert compilations(function) == 1
    assert f"cannot be stored in {file.parent}, so each process compiles them" in caplog.text
    assert not [*file.parent.glob("*.tmp.*")]


def test_an_inner_function_is_compiled_once_for_all_whole_numbers():
    """Numba would compile it for 0, and again for what the loop counts."""

    @compiled.noinline
    def more(number):
        return number + 1

    @compiled.compiled()
    def count(to):
        number = 0
        while number < to:
            number = more(number)
        return number

    assert count(3) == 3 and len(more.overloads) == 1


@pytest.mark.extended
def test_compiling_is_told_once_and_not_when_loops_are_loaded(package):
    tell = (
        "import logging, sys; import raybeam.compiled as c; c._LOG_AFTER_S = 1e-9; "
        "logging.basicConfig(level=logging.INFO, stream=sys.stdout, format='%(message)s'); "
        "import loops.more"
    )
    path = {**os.environ, "PYTHONPATH": str(Path(compiled.__file__).parents[1])}
    command = [sys.executable, "-c", tell]
    options = {"cwd": package.parent, "env": path, "capture_output": True, "text": True}
    told = [subprocess.run(command, check=True, **options).stdout for _ in range(2)]
    assert told == [f"{compiled.COMPILING}\n", ""]
