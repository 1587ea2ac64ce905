"""The example of another workflow, as a user would run it."""

import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from poolpart import PipeFailed

EXAMPLE = Path(__file__).parents[2] / "examples" / "thumbnails.py"


def thumbnail(number):
    picture = np.random.default_rng(number).integers(0, 256, (240, 320, 3), np.uint8)
    return picture.reshape(30, 8, 40, 8, 3).mean(axis=(1, 3)).astype(np.uint8)


def test_thumbnails_come_in_order(tmp_path):
    path = tmp_path / "out.npy"
    command = [sys.executable, EXAMPLE, path, "--count", "20"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    assert "<Partition 'CPU': 2 workers" in done.stdout
    assert f"20 thumbnails in {path}" in done.stdout
    assert np.array_equal(np.load(path), [thumbnail(number) for number in range(20)])


def test_an_error_of_the_writer_reaches_the_driver(start, tmp_path):
    client = start({name: {} for name in "abc"})
    with pytest.raises((FileNotFoundError, PipeFailed), match="No such file or directory"):
        runpy.run_path(str(EXAMPLE))["run"](client, tmp_path / "none" / "out.npy", 3)
    assert not client.cluster.scheduler.extensions["queues"].queues


def test_it_is_short():
    assert len(EXAMPLE.read_text().splitlines()) <= 60
