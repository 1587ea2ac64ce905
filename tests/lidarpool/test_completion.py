"""Completion of values by the shell: sensors, columns, formats and the like."""

from __future__ import annotations

import os
import subprocess
import sys

import click
import pytest
from click.shell_completion import CompletionItem, ShellComplete
from tests.plugin_files import write_distribution

from lidarfiles.clouds.built_in_formats import EXPORTS, LAYOUTS
from lidarlive.playback.bridge_table import BRIDGES
from lidarpool.cli.commands import cli
from lidarsim.columns.table import OPTIONAL, TABLE
from lidarsim.schema.model_names import model_names
from lidarsim.schema.vocabulary import ALWAYS_COLUMNS, COMPOSED_COLUMNS, OPTIONAL_COLUMNS
from lidarview.render.coloring import NORMALS, RGB


def items(line: str) -> list[CompletionItem]:
    """Return what completes the last word of a command line."""
    *words, incomplete = line.split(" ")
    shell = ShellComplete(cli, {}, "lidarpool", "_LIDARPOOL_COMPLETE")
    return shell.get_completions(words[1:], incomplete)


def completed(line: str) -> list[str]:
    """Return the values that complete the last word of a command line."""
    return [item.value for item in items(line) if item.type == "plain"]


def offers_files(line: str) -> bool:
    """Return True if the shell completes names of files."""
    return "file" in [item.type for item in items(line)]


OS1 = ["ouster/os1-128", "ouster/os1-32", "ouster/os1-64"]


@pytest.mark.parametrize(
    ("line", "values"),
    [
        ("lidarpool sensors velodyne/vlp1", ["velodyne/vlp16", "velodyne/vlp16-hires"]),
        ("lidarpool sensors velo", [m for m in model_names() if m.startswith("velo")]),
        ("lidarpool sensors ", [*model_names()]),
        ("lidarpool sensors mid3", ["mid360"]),  # without its maker
        ("lidarpool run hall.glb --sensor ouster/os1", OS1),
        ("lidarpool run hall.glb --sensor=ouster/os1", OS1),
        ("lidarpool check hall.glb --sensor ouster/os1", OS1),
        ("lidarpool init --mesh hall.glb --sensor ouster/os1", OS1),
        (
            "lidarpool stations hall.glb --sensor riegl-vz",
            ["riegl-vz1000", "riegl-vz2000i", "riegl-vz400"],
        ),
        ("lidarpool fit a.pcap --model ouster/os1", OS1),
        ("lidarpool augment a.pcap --sensor ouster/os1", OS1),
        ("lidarpool augment a.pcap --insert ", ["car", "pedestrian"]),
        ("lidarpool augment a.pcap --insert car --at 1,2 --mode t", ["two_strongest"]),
        ("lidarpool run hall.glb --columns ra", ["ray", "range", "radial_velocity"]),
        ("lidarpool run hall.glb --columns range,ray,ra", ["range,ray,radial_velocity"]),
        ("lidarpool plot out --color inc", ["incidence_deg"]),
        ("lidarpool plot out --color rg", ["rgb"]),
        ("lidarpool export out --format ", [*EXPORTS]),
        ("lidarpool export out -f la", ["las", "laz"]),
        ("lidarpool export out --layout ", [*LAYOUTS]),
        ("lidarpool run hall.glb --format las,ros", ["las,rosbag2"]),
        ("lidarpool run hall.glb --unit m", ["mm", "m", "mi"]),
        ("lidarpool run hall.glb --up-axis ", ["x", "y", "z"]),
        ("lidarpool run hall.glb --backend ti", ["tiles"]),
        ("lidarpool run hall.glb --live ", ["page", "foxglove", "rerun"]),
        ("lidarpool demo --live re", ["rerun"]),
        ("lidarpool play out --as ", [*BRIDGES]),
        ("lidarpool compare a b --match ", ["order", "time"]),
        ("lidarpool sensors vlp16 --as m", ["mujoco", "mjcf"]),
        ("lidarpool sensors vlp16 --out a.XML --as ", ["mjcf", "helios"]),
        ("lidarpool sensors vlp16 --out out/a.p", ["out/a.py", "out/a.parquet", "out/a.png"]),
        ("lidarpool sensors vlp16 --as livox --out a.", ["a.csv"]),
        ("lidarpool scene points a.ply b.glb --color i", ["intensity"]),
    ],
)
def test_values_are_completed(line, values):
    assert completed(line) == values


def test_names_of_files_are_completed_where_a_sensor_or_scenario_may_be_a_file():
    assert offers_files("lidarpool sensors my")
    assert offers_files("lidarpool sensors vlp16 --out ")
    assert offers_files("lidarpool run hall.glb --sensor ")
    assert offers_files("lidarpool run --live hal")  # alone, before a scenario
    assert not offers_files("lidarpool demo --live ")


def test_every_option_with_a_known_list_is_completed():
    """Options whose words are free have no list; these must not be forgotten."""
    listed = {"MODEL|FILE", "MODEL|FILE.yaml", "[MODEL|FILE.yaml]", "NAME,…", "BRIDGE"}

    def parameters(command):
        for sub in getattr(command, "commands", {}).values():
            yield from parameters(sub)
        yield from ((command.name, parameter) for parameter in command.params)

    for name, parameter in parameters(cli):
        if getattr(parameter, "metavar", None) in listed:
            context = click.Context(cli, resilient_parsing=True)
            assert parameter.shell_complete(context, ""), (name, parameter.name)


def test_the_names_that_are_completed_are_those_of_the_tables():
    assert (*ALWAYS_COLUMNS, *OPTIONAL_COLUMNS) == (*TABLE,)
    assert tuple(column.name for column in OPTIONAL) == OPTIONAL_COLUMNS
    assert (RGB.name, NORMALS.name) == COMPOSED_COLUMNS


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    """Install a sensor, a format and a command of another distribution."""
    entry_points = {
        "lidarsim.sensors": {"acmeco": "acmeco_sensors"},
        "lidarpool.clouds": {"zzz": "acmeco_clouds:ROW"},
        "lidarpool.commands": {"highest": "acmeco_commands:highest"},
    }
    modules = {"acmeco_sensors/__init__.py": "", "acmeco_sensors/acmeco/spin.yaml": "name: Spin\n"}
    monkeypatch.syspath_prepend(write_distribution(tmp_path, "acmeco", entry_points, modules))


@pytest.mark.usefixtures("plugin")
def test_values_and_commands_of_plugins_are_completed():
    assert completed("lidarpool sensors acme") == ["acmeco/spin"]
    assert completed("lidarpool export out --format z") == ["zzz"]
    assert completed("lidarpool run a.glb --format las,z") == ["las,zzz"]
    assert completed("lidarpool high") == ["highest"]  # whose module is missing


def test_completing_a_value_loads_nothing_of_a_run_and_no_plugins():
    line = "lidarpool run a.glb --columns range --format las --sensor ouster/os1"
    environment = {"COMP_WORDS": line, "COMP_CWORD": "8", "_LIDARPOOL_COMPLETE": "bash_complete"}
    completing = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "lidarpool"],
        capture_output=True, text=True, check=True, env=os.environ | environment,
    )  # fmt: skip
    assert completing.stdout.split() == ["file,ouster/os1", *(f"plain,{name}" for name in OS1)]
    loaded = {line.split("|")[-1].strip() for line in completing.stderr.splitlines()}
    assert "click" in loaded
    heavy = {"numpy", "pydantic", "dask", "distributed", "yaml", "importlib.metadata"}
    assert not heavy & loaded
