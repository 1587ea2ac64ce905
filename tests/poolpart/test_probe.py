"""Listing CUDA devices: without a driver, with one that works, with ones that do not."""

import logging
import shutil
import subprocess

import pytest

from poolpart import probe

FAKE = """
#include <string.h>
#include <stdlib.h>
int cuInit(unsigned flags) { BODY return 0; }
int cuDeviceGetCount(int *count) { *count = 2; return 0; }
int UUID(unsigned char *uuid, int device) { memset(uuid, 16 + device, 16); return ERROR; }
"""


@pytest.fixture
def fake_driver(tmp_path, monkeypatch):
    """Install a driver whose cuInit does what is given; needs a C compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler to make a driver with")

    def install(body="", uuid="cuDeviceGetUuid", error="0"):
        source = tmp_path / "fake.c"
        library = tmp_path / "libfake.so"
        source.write_text(FAKE)
        defines = [f"-DBODY={body}", f"-DUUID={uuid}", f"-DERROR={error}"]
        command = [compiler, "-w", "-shared", "-fPIC", *defines, "-o", library, source]
        subprocess.run(command, check=True)
        monkeypatch.setattr(probe, "CUDA_DRIVER", str(library))
        probe.list_gpus.cache_clear()

    yield install
    probe.list_gpus.cache_clear()


def said(caplog):
    """What was logged here; the clusters of other tests may say something of their own."""
    return [record for record in caplog.records if record.name.startswith("poolpart")]


@pytest.mark.parametrize("function", ["cuDeviceGetUuid", "cuDeviceGetUuid_v2"])
def test_devices_are_known_by_their_uuid(fake_driver, function):
    fake_driver(uuid=function)
    assert probe.visible_gpus() == ("10" * 16, "11" * 16)


def test_a_driver_without_devices(fake_driver, caplog):
    fake_driver(body="return 100;")
    with caplog.at_level(logging.WARNING, "poolpart"):
        assert probe.visible_gpus() == ()
    assert not said(caplog)


@pytest.mark.parametrize(
    ("options", "why"),
    [({"body": "abort();"}, "SIGABRT"), ({"error": "999"}, "of device 0 gives error 999")],
)
def test_a_broken_driver_counts_as_none_and_is_reported(fake_driver, caplog, options, why):
    fake_driver(**options)
    with caplog.at_level(logging.WARNING, "poolpart"):
        assert probe.visible_gpus() == ()
    assert "No GPU is used, because the GPUs could not be listed" in caplog.text
    assert why in caplog.text
