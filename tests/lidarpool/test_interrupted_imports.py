"""Ctrl-C while Open3D is being imported: it is an interrupt, not a package that fails."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from lidarpool import Cloud, save_cloud
from lidarpool.run.checks import check_backend_here

# What an extension module makes of an interrupt in its first lines.
INTERRUPTED = """
import signal
try:
    signal.raise_signal(signal.SIGINT)
except KeyboardInterrupt as error:
    raise ImportError("initialization failed") from error
"""


@pytest.fixture
def interrupted_open3d(tmp_path, monkeypatch):
    (tmp_path / "open3d").mkdir()
    (tmp_path / "open3d" / "__init__.py").touch()
    (tmp_path / "open3d" / "pybind.py").write_text(INTERRUPTED)
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("open3d", "open3d.pybind"):
        monkeypatch.setitem(sys.modules, name, None)  # put back afterwards, whatever it was
        del sys.modules[name]


@pytest.mark.parametrize("wanted", ["embree", "numpy"])
def test_while_it_is_looked_for_backends(interrupted_open3d, wanted):
    with pytest.raises(KeyboardInterrupt):
        check_backend_here(wanted)


def test_while_a_cloud_is_written(interrupted_open3d, tmp_path):
    one = np.zeros(1, np.int32)
    cloud = Cloud(np.zeros((1, 3)), {"scan": one, "channel": one, "object": one})
    with pytest.raises(KeyboardInterrupt):
        save_cloud(tmp_path / "cloud.ply", cloud)
    assert not list(tmp_path.glob("*cloud*"))
