"""The first line of a command, and the line on loops that are compiled."""

import logging
import re

import pytest
from click.testing import CliRunner

from lidarpool.cli import first_step
from lidarpool.cli.commands import cli
from raybeam import compiled

STEP = re.compile(r"\d\d:\d\d:\d\d  reading the scene\n")


@pytest.fixture(autouse=True)
def as_before():
    yield
    first_step.print_first_step("", quiet=True)


@pytest.mark.parametrize("command", ["check", "run", "stations"])
def test_the_first_step_is_told_before_anything_is_read(command, tmp_path):
    options = ["--sensor", "riegl-vz400"] * (command == "stations")
    ended = CliRunner().invoke(cli, [command, str(tmp_path / "none.yaml"), *options])
    assert STEP.match(ended.stderr) and "none.yaml" in str(ended.exception)


@pytest.mark.parametrize(("command", "quiet"), [("check", "--json"), ("run", "-q")])
def test_a_quiet_command_tells_no_step(command, quiet, tmp_path):
    ended = CliRunner().invoke(cli, [command, str(tmp_path / "none.yaml"), quiet])
    assert "reading" not in ended.stderr


def test_the_first_step_of_mount_is_the_vehicle(tmp_path):
    ended = CliRunner().invoke(cli, ["mount", str(tmp_path / "none.yaml")])
    assert "reading the vehicle\n" in ended.stderr and "none.yaml" in str(ended.exception)


def test_compiling_is_told_where_logs_are_dropped(capsys, monkeypatch):
    logger = logging.getLogger("raybeam.compiled")
    monkeypatch.setattr(logging.root.manager, "disable", logging.CRITICAL)
    first_step.print_first_step("reading the scene")
    first_step.print_first_step("reading the scene")  # as a second command of the process
    capsys.readouterr()
    logger.info(compiled.COMPILING)
    assert re.fullmatch(
        r"\d\d:\d\d:\d\d  compiling the ray-casting loops, which takes about 20 s the first time\n",
        capsys.readouterr().err,
    )
    first_step.print_first_step("reading the scene", quiet=True)
    logger.info(compiled.COMPILING)
    assert capsys.readouterr().err == ""


def test_a_terminal_gets_a_status_in_place_of_the_first_step(capsys, monkeypatch):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    first_step.print_first_step("reading the scene")
    assert capsys.readouterr().err == ""
