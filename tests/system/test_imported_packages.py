"""What a statement imports: large packages only where the statement needs them."""

from __future__ import annotations

import subprocess
import sys

import pytest

_DRAWING = {"jinja2", "matplotlib", "tornado"}
_CLUSTER = {"dask", "distributed", "poolpart", "rich"}
# Numba, which reconstructions compile their loops with, imports SciPy.
_LARGE = _DRAWING | _CLUSTER | {"numba", "open3d", "scipy", "trimesh"}


def imported(statement: str) -> set[str]:
    """Names of all packages that a new process has imported after the statement."""
    code = f"{statement}; import sys; print(*{{name.partition('.')[0] for name in sys.modules}})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return {*done.stdout.split()}


@pytest.mark.extended(keep=("augment", "twin"))
@pytest.mark.parametrize(
    ("statement", "absent"),
    [
        pytest.param("import lidarpool", {*_LARGE, "pydantic"}, id="lidarpool"),
        pytest.param("from lidarpool import Recording", _LARGE, id="Recording"),
        pytest.param("from lidarpool import open_recording", _LARGE, id="open_recording"),
        pytest.param("from lidarpool import Scanner", _LARGE, id="Scanner"),
        pytest.param("from lidarpool import save_cloud, read_cloud", _LARGE, id="clouds"),
        pytest.param("from lidarpool import augment", _LARGE, id="augment"),
        pytest.param("from lidarpool import compare", _LARGE, id="compare"),
        pytest.param("from lidarpool import compare_surveys", _LARGE, id="surveys"),
        pytest.param("from lidarpool import twin", _LARGE - {"numba", "scipy"}, id="twin"),
        pytest.param("from lidarpool import fit", _LARGE - {"numba", "scipy"}, id="fit"),
        pytest.param("from lidarpool import play", _LARGE - {"numba", "scipy"}, id="play"),
        pytest.param("from lidarpool import simulate", {"matplotlib", "open3d"}, id="simulate"),
        pytest.param("import lidarscenario.scenario", _LARGE, id="scenario"),
        pytest.param("import lidarscenario.occupancy.writing", _LARGE, id="occupancy"),
        pytest.param(
            "import lidarscenario.mounting.study", _LARGE - {"numba", "scipy"}, id="mount"
        ),
        pytest.param(
            "import lidarscenario.mounting.study_files", _LARGE - {"numba", "scipy"}, id="ranking"
        ),
        *(
            pytest.param(f"import lidarpool.cli.{name}_command", _LARGE, id=f"{name} command")
            for name in ("flight", "mount", "occupancy", "stations")
        ),
        pytest.param("import lidarscenario.plan.stations", _LARGE, id="stations"),
        pytest.param("import lidarlive.following.node", _LARGE, id="follow"),
        pytest.param("import lidarlive.serving.service", _LARGE - {"numba", "scipy"}, id="serve"),
        pytest.param("import lidarfiles.work.process_pool", _LARGE, id="processes"),
    ],
)
def test_large_packages_are_imported_when_they_are_needed(statement, absent):
    assert not absent & imported(statement)
