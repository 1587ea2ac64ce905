"""Columns and sensors of a user's own: from their module to the files of the result."""

import json
from dataclasses import dataclass, field

import laspy
import numpy as np
import pytest

from lidarpool import (
    Beams,
    Column,
    Scene,
    Sensor,
    Survey,
    read_cloud,
    save_cloud,
    simulate,
    to_dask,
    to_open3d,
)


@dataclass(frozen=True)
class Nod:
    """A head that looks up and down a wedge: a firing at each azimuth, to and fro."""

    azimuths_in_wedge: int = 40
    wedge_deg: float = 90.0

    @property
    def period(self) -> int:
        return 2 * self.azimuths_in_wedge

    def firings(self, step: int) -> tuple[int, int]:
        return step * self.azimuths_in_wedge, (step + 1) * self.azimuths_in_wedge

    def times_ns(self, firings):
        return np.asarray(firings, np.float64) * 50_000.0

    def azimuths(self, firings):
        at = firings % self.period
        at = np.where(at < self.azimuths_in_wedge, at, self.period - 1 - at)
        return np.radians(self.wedge_deg * at / self.azimuths_in_wedge)


@dataclass(frozen=True, eq=False)
class Tilted(Sensor):
    """A sensor that lies on its side: its beams fan out about the x axis."""

    tilt_deg: float = 30.0
    head: Nod = field(default_factory=Nod)

    def directions(self, firings):
        x, y, z = np.moveaxis(super().directions(firings), -1, 0)
        c = np.cos(np.radians(self.tilt_deg))
        s = np.sin(np.radians(self.tilt_deg))
        return np.stack([x, c * y - s * z, s * y + c * z], axis=-1)


def brightness(returns):
    """Light that comes back, falling with the square of the distance."""
    return returns.intensity / np.maximum(returns.range, 1.0) ** 2


BRIGHTNESS = Column("brightness", "float32", "W", "light that comes back", brightness)


def survey(**columns) -> Survey:
    sensor = Tilted(Beams.even(12, 50.0))
    return Survey(sensor, [(0, 0, 1.5), (4, 2, 1)], steps=30, keep_every=1, **columns)


@pytest.fixture(scope="module")
def result(local_client):
    wanted = survey(columns=[BRIGHTNESS, "time", "range", "intensity"])
    return simulate(Scene.seed(), wanted, client=local_client)


@pytest.mark.extended
def test_points_lie_where_the_sensors_own_geometry_says(result):
    """Its rays are made again here, and end at the ranges that were found."""
    cloud = result.cloud
    wanted = survey()
    assert result.rays == wanted.ray_count == 2 * 30 * 40 * 12
    assert len(cloud) == result.hit_count > 1000
    firings = cloud["time"] % (30 * 40 * 50_000) // 50_000
    stations = cloud.scan // 30
    places = np.array([(0, 0, 1.5), (4, 2, 1)])[stations]
    directions = wanted.sensor.directions(firings)[np.arange(len(cloud)), cloud.channel]
    expected = places + directions * cloud["range"][:, None]
    assert np.abs(cloud.positions - expected).max() <= 0.006


@pytest.mark.extended
@pytest.mark.usefixtures("pictures")
def test_a_result_tells_of_itself_and_its_points_become_frames_and_clouds(result, local_client):
    told = repr(result)
    assert told.startswith("survey: 60 scans (60 sweeps), 28,800 rays")
    assert (
        f"cloud: {len(result.cloud):,} points: x, y, z, scan, channel, object, brightness" in told
    )
    assert result._repr_html_().count("<tr>") == len(told.splitlines()) + 3
    cloud = result.cloud
    frame = cloud.to_dataframe()
    lazy = to_dask(result.points)
    assert list(frame) == [*"xyz", "scan", "channel", "object", "brightness", *frame.columns[7:]]
    np.testing.assert_array_equal(frame["z"], cloud.positions[:, 2])
    assert lazy.npartitions == sum(rows > 0 for rows in result.points.rows)
    np.testing.assert_array_equal(local_client.compute(lazy).result()["time"], cloud["time"])
    found = to_open3d(cloud).point
    np.testing.assert_array_equal(found["positions"].numpy(), cloud.positions)
    np.testing.assert_array_equal(found["ring"].numpy()[:, 0], cloud.channel)


@pytest.mark.extended
def test_points_and_cloud_are_saved_alike_with_every_column(result, tmp_path):
    save_cloud(result.points, tmp_path / "points.laz")
    save_cloud(result.cloud, tmp_path / "cloud.laz")
    assert (tmp_path / "points.laz").read_bytes() == (tmp_path / "cloud.laz").read_bytes()
    las = laspy.read(tmp_path / "cloud.laz")
    np.testing.assert_allclose(las.xyz, result.cloud.positions, atol=1e-9)
    np.testing.assert_array_equal(las["brightness"], result.cloud["brightness"])
    save_cloud(result.points, tmp_path / "pcd", format="pcd")
    assert len(list((tmp_path / "pcd").iterdir())) == len(result.cloud.sweeps())


def test_both_are_in_the_files_of_the_result(result, tmp_path):
    result.report(tmp_path)
    report = json.loads((tmp_path / "report.json").read_text())
    names = [column["name"] for column in report["columns"]]
    assert names == ["scan", "channel", "object", "brightness", "time", "range", "intensity"]
    (own,) = (column for column in report["columns"] if column["name"] == "brightness")
    assert (own["unit"], own["meaning"]) == ("W", "light that comes back")
    values = result.cloud["brightness"]
    limits = [own["lowest"], own["highest"]]
    assert limits == pytest.approx([values.min(), values.max()])
    sensor = report["parameters"]["sensor"]
    assert sensor["kind"] == "Tilted with 12 channels"
    assert (sensor["head"]["kind"], sensor["channels"]) == ("Nod", 12)
    page = (tmp_path / "report.html").read_text()
    assert "brightness" in page and "light that comes back" in page
    assert "Tilted with 12 channels" in page

    cloud = read_cloud(tmp_path / "cloud.ply")
    assert np.array_equal(cloud["brightness"], values)
    header = (tmp_path / "cloud.ply").read_bytes().partition(b"end_header")[0]
    assert b"property float brightness" in header
