"""raybeam and poolpart can be had without the rest."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CASTS = """
import numpy as np
from raybeam import RayCaster
caster = RayCaster(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float), [[0, 1, 2]])
print(caster.backend, caster.cast([0.2, 0.2, 5.0], [[0, 0, -1], [0, 0, 1]]).distance)
"""
DIVIDES = """
from distributed import Client
from poolpart import Pool, local_cluster
if __name__ == "__main__":
    with local_cluster({"A": (1, 1), "B": (1, 2)}) as cluster, Client(cluster) as client:
        pool = Pool.from_client(client)
        print(*pool.partitions(), sum(pool.partitions()["B"].map(abs, range(-9, 0))))
"""


def declared(folder: str) -> dict:
    project = tomllib.loads((ROOT / folder / "pyproject.toml").read_text(encoding="utf-8"))
    return project["project"]


@pytest.mark.parametrize("folder", ["kernels", "scheduler"])
def test_a_part_wants_what_the_whole_wants(folder):
    whole, part = declared("."), declared(folder)
    extras = whole["optional-dependencies"]
    assert set(part["dependencies"]) < set(whole["dependencies"])
    for name, wanted in part.get("optional-dependencies", {}).items():
        assert set(wanted) <= set(extras.get(name, whole["dependencies"]))
    assert part["requires-python"] == whole["requires-python"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "code", "says", "most"),
    [
        ("kernels", CASTS, "numpy [ 5. inf]\n", 2),
        ("kernels[embree]", CASTS, "embree [ 5. inf]\n", 3),
        ("scheduler", DIVIDES, "A B 45\n", 25),
    ],
)
def test_a_part_by_itself_in_an_empty_environment(tmp_path, what, code, says, most):
    """It is had from where packages come from, hence slow."""
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], check=True)
    pip = [tmp_path / "venv" / "bin" / "python", "-m", "pip", "--disable-pip-version-check"]
    subprocess.run([*pip, "install", "--quiet", ROOT / what], check=True)
    listed = subprocess.run([*pip, "list", "--format=json"], check=True, stdout=subprocess.PIPE)
    names = {entry["name"] for entry in json.loads(listed.stdout)} - {"pip", "setuptools"}
    assert len(names) <= most and not {"lidarpool", "open3d-cpu"} & names
    (tmp_path / "it.py").write_text(code, encoding="utf-8")
    done = subprocess.run([pip[0], "-I", "it.py"], cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    assert done.stdout == says
