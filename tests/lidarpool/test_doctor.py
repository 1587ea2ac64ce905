"""What is to be fixed first in an environment."""

import re
import socket
from contextlib import closing

import pytest

from lidarpool.cli import doctor
from lidarsim.base.extras import install_command
from raybeam import installation

SOUND = {
    "machine": {"available_memory_gib": 8.0, "disk_gib": {"/tmp": 9.0}},
    "gpus": [],
    "backends": {"cuda": "CuPy is not installed", "tiles": "ready"},
    "open3d": "ready",
}


def test_nothing_is_wrong_without_a_gpu():
    assert doctor._fix_first(SOUND) == ""
    assert doctor.advice_in_words({"fix_first": ""}) == "nothing needs to be fixed."


@pytest.mark.parametrize(
    ("changes", "advice"),
    [
        ({"gpus": ["GPU-1"]}, "a GPU that is not used: CuPy is not installed"),
        (
            {"backends": {"tiles": "pip install numba"}},
            "hundred times slower .* pip install numba",
        ),
        ({"machine": {"available_memory_gib": 0.4, "disk_gib": {}}}, "0.4 GiB of memory are free"),
        ({"machine": {"available_memory_gib": 9, "disk_gib": {"/tmp": 0.2}}}, "/tmp has 0.2 GiB"),
        ({"open3d": "it lacks libGL", "gpus": ["GPU-1"]}, "it lacks libGL"),
    ],
)
def test_the_most_urgent_is_named(changes, advice):
    first = doctor._fix_first(SOUND | changes)
    assert re.search(advice, first), first
    assert doctor.advice_in_words({"fix_first": first}).startswith("fix first: ")


def test_without_a_folder_for_compiled_loops(monkeypatch):
    monkeypatch.setattr(doctor, "HAS_CACHE", False)
    assert "NUMBA_CACHE_DIR" in doctor._fix_first(SOUND)


@pytest.mark.extended
def test_a_port_that_is_in_use(monkeypatch):
    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        port = server.getsockname()[1]
        monkeypatch.setattr(doctor, "PORTS", {port: "a test"})
        assert doctor._port_state(port) == "in use"
        figures = doctor.examine()
        lines = doctor.in_words(figures)
        assert any(f"{port} " in line and "in use, for a test" in line for line in lines)


def test_extras_are_added_in_the_checkout(monkeypatch):
    monkeypatch.setattr(installation, "find_spec", lambda name: "a spec")
    at = "in a checkout of lidarpool (docs/install.md#extras)"
    assert install_command("lidarpool[las]") == f'pip install ".[las]" {at}'
    assert install_command("lidarpool") == f"pip install . {at}"
    assert install_command("torch") == "pip install torch"
    assert f"extras         added {at}" in doctor.in_words(doctor.examine())


def test_an_extra_that_is_missing_names_its_command(monkeypatch):
    monkeypatch.setattr(
        doctor,
        "requires",
        lambda name: ["laspy>=2.5; extra == 'las'", "nowhere>=1; extra == 's3'", "numpy>=2"],
    )
    states = doctor._extras()
    assert states["las"] == "ready" and states["s3"] == 'pip install ".[s3]"'
    assert "dev" not in states
