"""Test faults in forks of a process that has imported the packages, which saves seconds each time.

A fault replaces the code of functions in memory. Compiled loops, and processes that tests start,
do not see it; for these the fault is planted in a copy of the project (`__main__`).

Run as a program, it reads requests from standard input, one JSON object per line, and answers each
with a line.
"""

import gc
import importlib
import json
import os
import pkgutil
import select
import signal
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

from tests.mutants.faults import ROOTS, Fault

ROOT = Path(__file__).parents[2]
PASSED = (0, 5)  # exit statuses of pytest: all passed, or all were deselected or skipped
PYTEST = ["-q", "-x", "-p", "no:cacheprovider", "-m", "not slow"]


class Forks:
    """Process that has imported all packages and tests one fault at a time."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.mutants.forks"],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def failure(self, fault: Fault | None, tests: list[str], limit_s: float) -> str | None:
        """Run tests with a fault, or without a fault if it is None.

        Returns
        -------
        str or None
            "by " and the name of the first test that failed, "hangs", or "" if all tests passed.
            None if the fault could not be planted, because no function in memory contains it.

        Raises
        ------
        RuntimeError
            If pytest could not run the tests.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        request = {"fault": fault and vars(fault), "tests": tests, "limit_s": limit_s}
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        answer: str | int | None = json.loads(self._process.stdout.readline())
        if isinstance(answer, int):
            raise RuntimeError(f"pytest ended with status {answer} for {' '.join(tests)}.")
        return answer

    def close(self) -> None:
        self._process.communicate()


class _First:
    """Pytest plugin that records the first failure."""

    def __init__(self) -> None:
        self.name = ""

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Record the name of the first test that fails."""
        if report.failed:
            self.name = self.name or f"by {report.nodeid}"

    def pytest_collectreport(self, report: Any) -> None:
        """Record the name of the first file that cannot be collected."""
        if report.failed:
            self.name = self.name or f"by {report.nodeid}"


def _serve() -> None:
    """Answer requests until standard input ends."""
    sys.path[:0] = [str(ROOT / root) for root in ROOTS] + [str(ROOT)]
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what imports print is no answer
    _import_everything()
    functions = _functions_by_file()
    for line in sys.stdin:
        request = json.loads(line)
        fault = Fault.read(request["fault"]) if request["fault"] else None
        answer = _try(fault, request, functions.get(str(ROOT / fault.path), []) if fault else [])
        print(json.dumps(answer), file=answers, flush=True)


def _import_everything() -> None:
    """Import pytest and all packages."""
    importlib.import_module("pytest")
    for root in ROOTS:
        for package in pkgutil.iter_modules([str(ROOT / root)]):
            folder = [str(ROOT / root / package.name)]
            for module in pkgutil.walk_packages(folder, f"{package.name}.", onerror=lambda _: None):
                if not module.name.endswith("__main__"):
                    _import_if_possible(module.name)


def _import_if_possible(name: str) -> None:
    """Import a module, or print why it cannot be imported."""
    try:
        importlib.import_module(name)
    except BaseException as error:
        print(f"not imported: {name}: {error}", file=sys.stderr)


def _functions_by_file() -> dict[str, list[types.FunctionType]]:
    """Return all functions in memory, keyed by the file that defines them."""
    gc.unfreeze()  # imports may have frozen what exists, and frozen objects are not listed
    found: dict[str, list[types.FunctionType]] = {}
    for thing in gc.get_objects():
        if isinstance(thing, types.FunctionType):
            found.setdefault(os.path.realpath(thing.__code__.co_filename), []).append(thing)
    return found


def _try(
    fault: Fault | None, request: dict[str, Any], functions: list[types.FunctionType]
) -> str | int | None:
    """Run `_failed` in a fork and return its result, or "hangs"."""
    reader, writer = os.pipe()
    child = os.fork()
    if child:
        os.close(writer)
        # An alarm in the child would be replaced by the timer of pytest-timeout.
        in_time, _, _ = select.select([reader], [], [], request["limit_s"])
        if not in_time:
            os.killpg(child, signal.SIGKILL)
        with os.fdopen(reader) as answers:
            answer = answers.read()
        os.waitpid(child, 0)
        result: str | int | None = json.loads(answer) if answer else "hangs"
        return result
    os.close(reader)
    os.setsid()
    nothing = os.open(os.devnull, os.O_RDWR)
    for number in range(3):
        os.dup2(nothing, number)
    try:
        failed = _failed(fault, request["tests"], functions)
        os.write(writer, json.dumps(failed).encode())
    finally:
        os._exit(0)


def _failed(
    fault: Fault | None, tests: list[str], functions: list[types.FunctionType]
) -> str | int | None:
    """Plant a fault in this process, run tests, and return the first test that failed.

    Return "" if all tests passed, None if the fault could not be planted, and the exit status of
    pytest if it could not run the tests.
    """
    import pytest

    if fault and not _plant(fault, functions):
        return None
    first = _First()
    status = pytest.main([*PYTEST, *tests], plugins=[first])
    return first.name or ("" if status in PASSED else int(status))


def _plant(fault: Fault, functions: list[types.FunctionType]) -> bool:
    """Replace the code of the functions that contain a fault.

    Return whether there were any.
    """
    path = ROOT / fault.path
    source = fault.plant(path.read_text())
    planted = _codes(compile(source, str(path), "exec", dont_inherit=True))
    found = False
    for function in functions:
        old = function.__code__
        new = planted.get((old.co_qualname, old.co_firstlineno))
        if new is not None and new != old and new.co_freevars == old.co_freevars:
            function.__code__ = new
            found = True
    return found


def _codes(code: types.CodeType) -> dict[tuple[str, int], types.CodeType]:
    """Return the code of all functions in a module, keyed by qualified name and first line."""
    found = {}
    waiting = [code]
    while waiting:
        for constant in waiting.pop().co_consts:
            if isinstance(constant, types.CodeType):
                found[constant.co_qualname, constant.co_firstlineno] = constant
                waiting.append(constant)
    return found


if __name__ == "__main__":
    _serve()
