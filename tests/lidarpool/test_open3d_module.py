"""Open3D is loaded without its viewers, and what it lacks is said."""

import subprocess
import sys

import pytest

from lidarpool.base.errors import LidarpoolError
from lidarpool.base.open3d_module import load_open3d


def test_it_comes_without_its_viewers_and_whole_to_whoever_imports_it():
    """Dash and Plotly take longer to import than all that writing needs.

    In a process of its own: pytest rewrites Dash, whose plugin it knows, and the many files of
    that can fail in Python 3.11 ("AST constructor recursion depth mismatch").
    """
    code = (
        f"import sys; sys.path[:] = {sys.path}; "
        "from lidarpool.base.open3d_module import load_open3d; o3d = load_open3d(); "
        "assert not {'open3d', 'dash', 'plotly'} & set(sys.modules); "
        "import open3d; assert open3d.t.geometry is o3d.t.geometry is load_open3d().t.geometry"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("name", ["open3d", "open3d.pybind"])
def test_what_it_lacks(monkeypatch, name):
    for module in ("open3d", "open3d.pybind"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(LidarpoolError, match=r"does not load .*open3d-cpu .*libegl1"):
        load_open3d()
