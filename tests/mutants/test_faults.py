"""Test that faults are found where values are computed, and are planted one at a time."""

import ast
from pathlib import Path

import pytest
from tests.mutants import faults
from tests.mutants.faults import choose, faults_in, function_spans, modules

PROJECT = Path(__file__).parents[2]

SOURCE = '''
"""Lengths."""

LIMIT = 3


class Line:
    def length(self, points, *, closed=True):
        """Return the length."""
        if points < 2:
            raise ValueError(f"{points + 1} are too few.")
        return max(points, 7) * 2.5 if closed and points else -points

    def __repr__(self):
        return "Line" * 2


@compiled("f8(f8)")
def double(x):
    log.warning("doubled", x + 2)
    return x + x
'''


@pytest.fixture
def root(tmp_path):
    (tmp_path / "kernels").mkdir()
    (tmp_path / "kernels" / "lines.py").write_text(SOURCE)
    return tmp_path


def test_faults_of_expressions(root):
    found = {(fault.before, fault.after) for fault in faults_in(root, "kernels/lines.py")}
    assert found == {
        ("points < 2", "points <= 2"),
        ("points < 2", "not (points < 2)"),
        ("2", "3"),
        ("max", "min"),
        ("7", "8"),
        ("max(points, 7) * 2.5", "max(points, 7) / 2.5"),
        ("2.5", "2.75"),
        ("closed and points", "closed or points"),
        ("closed and points", "not (closed and points)"),
        ("-points", "points"),
        ("x + x", "x - x"),
    }


def test_a_planted_fault_changes_one_expression(root):
    found = faults_in(root, "kernels/lines.py")
    for fault in found:
        planted = fault.plant(SOURCE)
        ast.parse(planted)
        changed = [
            (old, new)
            for old, new in zip(SOURCE.splitlines(), planted.splitlines(), strict=True)
            if old != new
        ]
        assert len(changed) == 1 and fault.after in changed[0][1]
    assert {fault.function for fault in found} == {"Line.length", "double"}
    assert [fault.compiled for fault in found if fault.function == "double"] == [True]


def test_a_fault_that_no_longer_fits_is_refused(root):
    fault = faults_in(root, "kernels/lines.py")[0]
    with pytest.raises(ValueError, match=r"kernels/lines\.py:\d+ has changed"):
        fault.plant("\n" + SOURCE)


def test_a_seed_always_chooses_the_same_faults(root):
    chosen = choose(root, ["kernels"], 5, seed=1)
    assert chosen == choose(root, ["kernels"], 5, seed=1) and len(set(chosen)) == 5
    assert chosen != choose(root, ["kernels"], 5, seed=2)
    assert len(choose(root, ["kernels"], 100, seed=1)) == 11


def test_spans_of_functions():
    assert function_spans(SOURCE) == {
        "Line.length": (9, 12),
        "Line.__repr__": (15, 15),
        "double": (20, 21),
    }


def test_packages_that_are_added_are_included(tmp_path):
    for path in ["kernels", "scheduler", "workflows/new/inner", "workflows/lidarpool/cli"]:
        (tmp_path / path).mkdir(parents=True)
    added = ["workflows/new/inner/values.py", "workflows/lidarpool/new.py"]
    skipped = ["workflows/lidarpool/cli/options.py", "workflows/lidarpool/new_charts.py"]
    for path in [*added, *skipped]:
        (tmp_path / path).write_text(SOURCE)
    assert modules(tmp_path) == sorted(added)
    with pytest.raises(ValueError, match="no package or file 'workflows/nwe'"):
        modules(tmp_path, ["workflows/nwe"])


def test_each_skipped_module_exists(monkeypatch):
    number = len(modules(PROJECT))
    for pattern in faults.SKIPPED_MODULES:
        others = [other for other in faults.SKIPPED_MODULES if other != pattern]
        monkeypatch.setattr(faults, "SKIPPED_MODULES", others)
        assert len(modules(PROJECT)) > number, pattern
        monkeypatch.undo()
