"""Scenarios, parts and clouds are data: nothing in them runs, whatever it says."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import lidarpool.cli.commands
import raybeam
from lidarpool import LidarpoolError, read_cloud
from lidarpool.scenario.scenario import Scenario

ROOTS = [
    Path(package.__file__).parent for package in (lidarpool, raybeam)
]  # poolpart reads no files
SOURCES = {
    str(path.relative_to(root.parent)): path for root in ROOTS for path in root.rglob("*.py")
}

# Modules that make objects of bytes. The one exception takes them from the run's own workers,
# over Dask's connections, which carry pickles anyway.
UNSAFE_MODULES = {"pickle", "cPickle", "marshal", "shelve", "dill", "cloudpickle", "joblib"}
UNPICKLES = {"lidarpool/scan/rig.py"}
UNSAFE_CALLS = {
    "eval", "exec", "os.system", "os.popen", "yaml.unsafe_load", "yaml.full_load", "np.save",
}  # fmt: skip


def imports(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.partition(".")[0]


def calls(tree: ast.AST) -> Iterator[tuple[str, ast.Call]]:
    return ((ast.unparse(node.func), node) for node in ast.walk(tree) if isinstance(node, ast.Call))


def test_no_module_runs_what_it_reads():
    for name, path in SOURCES.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        assert not UNSAFE_MODULES & set(imports(tree)) or name in UNPICKLES, name
        for function, call in calls(tree):
            assert function not in UNSAFE_CALLS, name
            words = {word.arg: ast.unparse(word.value) for word in call.keywords}
            if function.endswith(".load") and function.startswith(("np.", "numpy.")):
                assert words.get("allow_pickle", "False") == "False", name
            if function == "yaml.load":
                assert words["Loader"] == "_Loader", name


def test_the_look_at_modules_finds_something():
    assert "pickle" in set(imports(ast.parse("from pickle import loads")))
    assert "eval" in dict(calls(ast.parse("x = [eval(y) for y in z]")))
    assert len(SOURCES) > 100
    assert set(SOURCES) >= UNPICKLES


# -- scenarios ----------------------------------------------------------------------------------


def laughs() -> str:
    """YAML whose last list holds 10^9 others."""
    first = f"a: &a [{', '.join('1' * 10)}]\n"
    return first + "".join(
        f"{name}: &{name} [{', '.join([f'*{of}'] * 10)}]\n"
        for of, name in zip("abcdefgh", "bcdefghi", strict=True)
    )


@pytest.mark.parametrize(
    "text",
    [
        laughs() + "poses: *i\n",
        laughs() + "scene: {files: *i}\n",
        "poses: &p [*p]\n",
        "scene: &s {files: [*s]}\n",
        "steps: !!python/object/apply:os.getcwd []\n",
        "scene: {files: [!!python/name:os.system ]}\n",
        "sensor: {layers: " + "9" * 5000 + "}\n",
    ],
    ids=["laughs", "laughing files", "itself", "in itself", "call", "name", "digits"],
)
def test_a_scenario_made_to_do_harm(text, tmp_path):
    path = tmp_path / "s.yaml"
    path.write_text(text)
    with pytest.raises(LidarpoolError) as refused:
        Scenario.load(path)
    assert all(len(line) < 500 for line in str(refused.value).splitlines())


def test_a_complaint_commands_no_terminal(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(lidarpool.cli.commands, "interrupt_on_signals", lambda: None)
    monkeypatch.setattr(lidarpool.cli.commands, "set_logs", lambda shown: None)
    path = tmp_path / "s.yaml"
    path.write_text('scene: {files: ["\\e]0;title\\a\\r\\u202e.ply"]}\n')
    with pytest.raises(SystemExit):
        lidarpool.cli.commands.main(["run", str(path)])
    said = capsys.readouterr().err
    assert "title" in said
    assert all(line.isprintable() for line in said.splitlines())


# -- clouds -------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", ["1000000000000", "9" * 30, "9" * 5000, "-1"])
def test_a_cloud_that_announces_more_than_it_holds(count, tmp_path):
    path = tmp_path / "c.ply"
    path.write_text(
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {count}\nproperty float x\nproperty float y\nproperty float z\n"
        "property int scan\nproperty ushort ring\nproperty int object\nend_header\n"
    )
    with pytest.raises(LidarpoolError, match=r"c\.ply"):
        read_cloud(path)
