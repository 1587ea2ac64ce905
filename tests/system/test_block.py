"""A city block, a robot, hills and traffic in one scenario: examples/block.yaml."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim.simulator.rig import Rig

pytest.importorskip("pxr")
pytest.importorskip("rasterio")

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def scanned(tmp_path_factory):
    """The job, and columns of two turns: {name: (n,)}."""
    folder = tmp_path_factory.mktemp("block")
    for pattern in ("block*", "rover*", "car.obj"):
        for file in EXAMPLES.glob(pattern):
            shutil.copy(file, folder)
    built = prepare(Scenario.load(folder / "block.yaml"))
    job = built.job
    batches = list(Rig(job.scene, job.survey, "tiles").cast(0, 72))
    columns = {
        column.name: np.concatenate([column.make(batch) for batch in batches])
        for column in job.survey.stored_columns
    }
    return built, job, columns


def of(job, columns, name):
    """Rows of an object's points."""
    return columns["object"] == job.scene.object_names.index(name)


@pytest.mark.slow
def test_all_sources_are_in_one_scene_and_meshes_are_kept_once(scanned):
    built, job, _ = scanned
    assert [*built.findings.sources] == [
        "block.usdc", "block-hills.tif", "rover.urdf", "car.obj", "block-traffic.xml.gz"
    ]  # fmt: skip
    assert job.survey.epsg == 25832
    assert len(job.scene.instances) == 500
    assert job.scene.triangles > 4_000_000 and job.scene.kept_triangles < 50_000
    cars = [actor for actor in job.scene.actors if actor.name.startswith(("Car (", "Van ("))]
    assert len(cars) == 100 and len({id(car.mesh.vertices) for car in cars}) == 2


@pytest.mark.extended
def test_the_robot_and_the_cars_are_on_the_hills(scanned):
    _, job, _ = scanned
    at, _ = job.survey.path.poses(0, np.array([0.0, 1e9]))
    heights = at[:, 2] + job.scene.origin[2]
    x, y = (at[:, :2] + job.scene.origin[:2] - [691_000, 5_334_000]).T
    hills = 512 + 1.6 * np.sin(x / 47) + 1.1 * np.cos(y / 39)
    np.testing.assert_allclose(heights, hills, atol=0.05)


@pytest.mark.extended
def test_lane_markings_stand_out_and_cars_have_their_class(scanned):
    _, job, columns = scanned
    street = of(job, columns, "Street")
    white = street & (columns["red"] > 200)
    asphalt = street & (columns["red"] < 110)
    assert white.sum() > 100 < asphalt.sum()
    ratio = np.median(columns["reflectance"][white]) / np.median(columns["reflectance"][asphalt])
    assert ratio > 4
    names = np.array([name.split(" (")[0] for name in job.scene.object_names])
    kinds = names[columns["object"]]
    assert set(columns["class"][np.isin(kinds, ["Car", "Van"])]) == {10}
    assert (kinds == "Maple").sum() + np.char.startswith(kinds, "Maple.").sum() > 1000
    assert np.char.startswith(kinds, "Rover/").sum() > 10
