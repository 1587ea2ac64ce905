"""lidarsim and lidarscenes in a process without Dask, Open3D and Matplotlib."""

import json
import subprocess
import sys

import pytest

# Packages of a cluster, of clouds as files, of drawings and of the command.
ABSENT = (
    "dask", "distributed", "open3d", "matplotlib", "click", "rich", "lidarfiles", "lidarlive",
    "lidarpool", "lidarreal", "lidarscenario", "lidarview",
)  # fmt: skip

LOADED = f"""
import sys
from lidarsim import Scanner, load_sensor

shown = load_sensor("velodyne/vlp16")._repr_html_()
assert "Velodyne VLP-16" in shown and "<img" not in shown
print(sorted({{name.split(".")[0] for name in sys.modules}} & set({ABSENT!r})))
"""

# Every module is imported, then a sweep with effects of a scene that lidarscenes reads is cast.
WITHOUT = f"""
import sys
from importlib import import_module
from pkgutil import walk_packages


class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {ABSENT!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)


sys.meta_path.insert(0, Absent())
import lidarscenes
import lidarsim

for package in (lidarsim, lidarscenes):
    for module in walk_packages(package.__path__, package.__name__ + "."):
        if not module.name.endswith("_child"):  # which run in processes of their own
            import_module(module.name)
from lidarsim import Noise, Pose, Returns, Scanner, Scene, load_sensor

noise = Noise(range_m=0.02, dropout=0.01, detection_range_m=100.0)
sensor = load_sensor("velodyne/vlp16")
scene = Scene.load(sys.argv[1])
scanner = Scanner(scene, sensor, noise=noise, returns=Returns("dual", 7, 1.5), rain_mm_h=10.0)
print(len(scanner.sweep(Pose((0, 0, 2.0)))) > 1000)
"""


def run(code: str, *arguments: object) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_lidarsim_imports_neither_dask_nor_open3d_and_shows_tables_alone():
    assert run(LOADED) == "[]\n"


@pytest.mark.slow
def test_a_sweep_of_a_city_model_needs_none_of_them(tmp_path):
    surface = {"type": "MultiSurface", "lod": "1", "boundaries": [[[0, 1, 2, 3]]]}
    model = {
        "type": "CityJSON",
        "version": "1.1",
        "transform": {"scale": [1, 1, 1], "translate": [0, 0, 0]},
        "vertices": [[-20, -20, 0], [20, -20, 0], [20, 20, 0], [-20, 20, 0]],
        "CityObjects": {"Ground": {"type": "TINRelief", "geometry": [surface]}},
    }
    path = tmp_path / "town.city.json"
    path.write_text(json.dumps(model))
    assert run(WITHOUT, path).endswith("True\n")
