"""What is to be fixed first in an environment."""

import json
import re
import socket
from contextlib import closing
from importlib.metadata import PackageNotFoundError
from types import SimpleNamespace

import pytest

from lidarfiles.identity.versions import PACKAGES
from lidarpool.cli import doctor, installed_copies
from lidarsim.environment.extras import CHECKOUT, install_command
from raybeam import installation

SOUND = {
    "machine": {"available_memory_gib": 8.0, "disk_gib": {"/tmp": 9.0}},
    "gpus": [],
    "backends": {"cuda": "CuPy is not installed", "tiles": "ready"},
    "open3d": "ready",
    "second_copy": "",
    "cluster_fault": "",
}


def test_nothing_is_wrong_without_a_gpu():
    assert doctor._fix_first(SOUND) == ""
    assert doctor.advice_line({"fix_first": ""}) == "No problems were found."


@pytest.mark.parametrize(
    ("changes", "advice"),
    [
        ({"gpus": ["GPU-1"]}, "The GPU of this machine is not used: CuPy is not installed"),
        (
            {"backends": {"tiles": "pip install numba"}},
            "hundred times slower: pip install numba",
        ),
        (
            {"machine": {"available_memory_gib": 0.4, "disk_gib": {}}},
            "0.4 GiB of memory is",
        ),
        (
            {"machine": {"available_memory_gib": 9, "disk_gib": {"/tmp": 0.2}}},
            "only 0.2 GiB of free space",
        ),
        ({"second_copy": "There are two copies"}, "There are two copies"),
        ({"cluster_fault": "Too few slots", "gpus": ["GPU-1"]}, "Too few slots"),
        ({"open3d": "it lacks libGL", "gpus": ["GPU-1"]}, "it lacks libGL"),
    ],
)
def test_the_most_urgent_is_named(changes, advice):
    first = doctor._fix_first(SOUND | changes)
    assert re.search(advice, first), first
    assert doctor.advice_line({"fix_first": first}).startswith("fix first: ")


def test_without_a_folder_for_compiled_loops(monkeypatch):
    monkeypatch.setattr(doctor, "HAS_CACHE", False)
    assert "NUMBA_CACHE_DIR" in doctor._fix_first(SOUND)


@pytest.mark.extended
def test_a_port_that_is_in_use(monkeypatch):
    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        port = server.getsockname()[1]
        monkeypatch.setattr(doctor, "PORTS", {port: "a test"})
        assert doctor._port_state(port) == "in use"
        figures = doctor.check_environment()
        lines = doctor.result_lines(figures)
        assert any(f"{port} " in line and "in use (a test)" in line for line in lines)


@pytest.mark.extended
def test_extras_are_added_in_the_checkout(monkeypatch):
    monkeypatch.setattr(installation, "find_spec", lambda name: "a spec")
    at = "in a checkout of lidarpool (docs/install.md#extras)"
    assert install_command("lidarpool[las]") == f'pip install -e ".[las]" {at}'
    assert (
        install_command("lidarpool")
        == "pip install -e ./kernels -e ./scheduler -e ./workflows/lidarsim "
        "-e ./workflows/lidarfiles -e ./workflows -e . " + at
    )
    assert install_command("torch") == "pip install torch"
    assert f"extras         installed from {CHECKOUT}" in doctor.result_lines(
        doctor.check_environment()
    )


def test_an_extra_that_is_missing_names_its_command(monkeypatch):
    monkeypatch.setattr(
        doctor,
        "requires",
        lambda name: ["laspy>=2.5; extra == 'las'", "nowhere>=1; extra == 's3'", "numpy>=2"],
    )
    states = doctor._extras()
    assert states["las"] == "ready" and states["s3"] == 'pip install -e ".[s3]"'
    assert "dev" not in states


FOLDERS = {"raybeam": "kernels", "poolpart": "scheduler"}


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Return a function that fakes where packages are, and what is installed as editable."""
    monkeypatch.delenv("PYTHONPATH", raising=False)
    monkeypatch.chdir(tmp_path)
    checkout = tmp_path / "checkout"
    site = tmp_path / "site-packages"
    for package in PACKAGES:
        for folder in (checkout / FOLDERS.get(package, "workflows"), site):
            (folder / package).mkdir(parents=True)
            (folder / package / "__init__.py").touch()

    def install(in_site=(), editable=False):
        def find_spec(package):
            in_checkout = checkout / FOLDERS.get(package, "workflows")
            folder = site if package in in_site else in_checkout
            return SimpleNamespace(origin=str(folder / package / "__init__.py"))

        url = {"url": checkout.as_uri(), "dir_info": {"editable": True} if editable else {}}
        found = SimpleNamespace(read_text=lambda name: json.dumps(url))
        monkeypatch.setattr(installed_copies, "find_spec", find_spec)
        monkeypatch.setattr(installed_copies, "distribution", lambda name: found)
        return checkout, site

    return install


def test_a_copy_that_hides_an_editable_installation_is_reported(install):
    install(editable=True)
    assert installed_copies.find_second_copy() == ""
    checkout, site = install(in_site=PACKAGES, editable=True)
    assert installed_copies.find_second_copy() == (
        f"There are two copies of lidarpool: it is imported from {site}, so changes in "
        f"{checkout} have no effect. Uninstall lidarpool, lidarreal, lidarfiles, lidarsim, "
        "poolpart and raybeam, then run " + install_command("lidarpool")
    )


def test_packages_of_several_folders_are_reported(install):
    checkout, site = install(in_site=["raybeam"], editable=True)
    assert (
        f"raybeam is imported from {site}, and lidarpool from {checkout}. Uninstall"
        in installed_copies.find_second_copy()
    )


def test_a_checkout_that_is_not_what_runs_is_reported_unless_it_was_chosen(install, monkeypatch):
    checkout, site = install(in_site=PACKAGES)
    assert installed_copies.find_second_copy() == ""
    monkeypatch.chdir(checkout / "workflows")
    assert f"changes in {checkout} have no effect" in installed_copies.find_second_copy()
    monkeypatch.setenv("PYTHONPATH", str(site))
    assert installed_copies.find_second_copy() == ""


def test_packages_that_are_not_installed_have_no_second_copy(install, monkeypatch):
    def fail(name):
        raise PackageNotFoundError(name)

    checkout, _ = install()
    monkeypatch.setattr(installed_copies, "distribution", fail)
    monkeypatch.chdir(checkout)
    assert installed_copies.find_second_copy() == ""
