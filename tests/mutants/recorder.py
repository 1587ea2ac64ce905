"""Pytest plugin that records the lines that each test executes and the duration of each test.

Load it with ``-p tests.mutants.recorder``. Each process of pytest-xdist writes its results
to a file in the folder given by the environment variable `LIDARPOOL_MUTANTS`. Compiled loops, and
lines that are only executed by processes of a cluster, are not recorded.
"""

import json
import os
from collections import Counter, defaultdict
from collections.abc import Generator
from pathlib import Path

import coverage
import pytest
from tests.mutants.faults import ROOTS

_ROOT = Path(__file__).parents[2]
_folder = Path(os.environ["LIDARPOOL_MUTANTS"])
_coverage = coverage.Coverage(data_file=None, source=[str(_ROOT / root) for root in ROOTS])
_seconds: Counter[str] = Counter()


def pytest_configure() -> None:
    """Start recording before the packages are imported."""
    _coverage.start()


def test_name(nodeid: str) -> str:
    """Return the name of a test without parameters, in a form that pytest accepts."""
    return nodeid.partition("[")[0]


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Attribute all lines executed during a test to this test."""
    _coverage.switch_context(test_name(item.nodeid))
    try:
        return (yield)
    finally:
        _coverage.switch_context("")


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Add the duration of a setup, call or teardown."""
    _seconds[test_name(report.nodeid)] += report.duration


def pytest_unconfigure(config: pytest.Config) -> None:
    """Write the record of this process."""
    _coverage.stop()
    worker = getattr(config, "workerinput", {}).get("workerid", "main")
    data = _coverage.get_data()
    tests: dict[str, int] = {}
    lines: dict[str, dict[int, list[int]]] = {}
    for path in data.measured_files():
        if not path.endswith(".py"):  # templates
            continue
        by_line = defaultdict(list)
        for line, contexts in data.contexts_by_lineno(path).items():
            by_line[line] = [tests.setdefault(name, len(tests)) for name in contexts if name]
        lines[Path(path).relative_to(_ROOT).as_posix()] = {k: v for k, v in by_line.items() if v}
    record = {"tests": [*tests], "lines": lines, "seconds": _seconds}
    _folder.mkdir(parents=True, exist_ok=True)
    (_folder / f"{worker}.json").write_text(json.dumps(record))
