"""Scenarios, parts and clouds are data: nothing in them runs, whatever it says."""

from __future__ import annotations

import pytest

import lidarpool.cli.commands
from lidarpool import LidarpoolError, read_cloud
from lidarpool.scenario.scenario import Scenario


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
        "scene: &s {files: [*s]}\n",
        "scene: {files: [!!python/name:os.system ]}\n",
        "sensor: {layers: " + "9" * 5000 + "}\n",
    ],
    ids=["laughs", "laughing files", "in itself", "name", "digits"],
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
