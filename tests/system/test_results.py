"""What a result makes of itself in Python, and that others are not replaced unasked."""

import json
import re
import urllib.request
from dataclasses import replace

import pytest

from lidarpool import (
    LidarError,
    Planning,
    Result,
    Scene,
    SceneMesh,
    Sensor,
    Survey,
    read_cloud,
    simulate,
)
from lidarsim.scene.shapes import seed_objects

SENSOR = Sensor.grid(rays_per_revolution=90, layers=6)


@pytest.fixture(scope="module")
def scene() -> Scene:
    shapes = seed_objects(rings=6, segments=8)[:2]  # any triangles will do, those of trimesh too
    return Scene.from_meshes(SceneMesh(one.name, one.vertices, one.faces) for one in shapes)


@pytest.fixture(scope="module")
def result(cluster_client, scene) -> Result:
    planning = Planning((25, 25), (-30, -20), trials=1, particles=10, iterations=2)
    return simulate(
        scene, Survey(SENSOR, [(0, 0, 1)], 36, keep_every=5), planning, client=cluster_client
    )


@pytest.fixture
def another(result) -> Result:
    """The same points, as if a different survey had given them."""
    return replace(result, identity={**result.identity, "survey": "another"})


@pytest.mark.usefixtures("pictures")
def test_it_is_told_in_three_lines_and_shown_as_a_table_with_pictures(result, scene, monkeypatch):
    monkeypatch.setattr("lidarpool.api.result.PICTURE_SIZE", (480, 480))
    survey, cloud, path = repr(result).splitlines()
    assert survey.startswith("survey: 36 scans (1 sweep), 540 rays, ") and "2 objects" in survey
    assert "1 point, one in 5 hits of each scan (keep_every): x, y" in cloud
    assert path.startswith("path: ") and "no GPU" not in path
    shown = result._repr_html_()
    assert shown.startswith("<table>") and shown.count("data:image/png;base64,") == 2
    assert all(len(data) < 80_000 for data in re.findall('base64,([^"]*)"', shown))
    assert f">{result.backend}<" in shown and f">{result.points.storage.url}<" in shown
    assert result.objects == scene.names


@pytest.mark.usefixtures("pictures")
def test_pictures_are_drawn_and_what_they_cannot_be_is_told(result, tmp_path):
    made = result.pictures(tmp_path / "new", only=["cloud"], size=(480, 480), color="channel")
    assert made == [tmp_path / "new/cloud.png"] and made[0].read_bytes().startswith(b"\x89PNG")
    for wrong, words in (
        ({"only": ["clod"]}, "Did you mean 'cloud'"),
        ({"size": (10, 10)}, "480 to 4096"),
        ({"only": ["cloud"], "color": "rang"}, "no column 'rang'"),
        ({"only": "cloud"}, "only must be a list, but is 'cloud'"),
        ({"size": 480}, "size must be a list of 2 whole numbers, but is 480"),
    ):
        with pytest.raises(LidarError, match=words):
            result.pictures(tmp_path, **wrong)


def test_a_report_does_not_replace_that_of_another_survey_unasked(result, another, tmp_path):
    result.report(tmp_path, only_cloud=True)
    assert len(read_cloud(tmp_path / "cloud.ply")) == len(result.points)
    result.report(tmp_path, only_cloud=True)  # its own
    with pytest.raises(LidarError, match=r"contains the result of a different survey.*overwrite"):
        another.report(tmp_path)
    sparse = replace(another, survey=replace(another.survey, keep_every=7))
    words = r"of a different survey \(cloud\.keep_every changed from 5 to 7\).*overwrite"
    with pytest.raises(LidarError, match=words):
        sparse.report(tmp_path)
    another.report(tmp_path, only_cloud=True, overwrite=True)
    assert json.loads((tmp_path / "report.json").read_text())["identity"]["survey"] == "another"
    (tmp_path / "report.json").write_text("somebody's own")
    with pytest.raises(LidarError, match="a different survey"):
        another.report(tmp_path)


def test_files_of_no_result_are_neither_replaced_nor_removed_unasked(result, tmp_path):
    own = tmp_path / "kitti" / "notes.txt"
    own.parent.mkdir()
    own.write_text("mine")
    result.report(tmp_path, only_cloud=True)
    result.report(tmp_path, only_cloud=True)
    with pytest.raises(LidarError, match=r"contains kitti, which would be replaced .*--over"):
        result.report(tmp_path, only_cloud=True, formats=["kitti"])
    assert own.read_text() == "mine"
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "cloud.ply").write_text("mine")
    with pytest.raises(LidarError, match=r"other contains .*cloud\.ply"):
        result.report(tmp_path / "other", only_cloud=True)
    result.report(tmp_path / "other", only_cloud=True, overwrite=True)
    result.report(tmp_path / "other", only_cloud=True)


def test_a_folder_of_a_format_with_a_file_of_the_user_is_not_replaced(result, tmp_path):
    result.report(tmp_path, only_cloud=True, formats=["pcd"])
    own = tmp_path / "pcd" / "notes.txt"
    own.write_text("mine")
    for formats in (["pcd"], []):  # it would be replaced, and removed
        with pytest.raises(LidarError, match=r"pcd/notes\.txt was not written by lidarpool"):
            result.report(tmp_path, only_cloud=True, formats=formats, overwrite=True)
    assert own.read_text() == "mine" and (tmp_path / "report.json").exists()
    own.unlink()
    result.report(tmp_path, only_cloud=True, overwrite=True)
    assert not own.parent.exists()


@pytest.mark.extended
def test_its_page_and_that_of_its_run(result, scene, cluster_client, monkeypatch, capsys):
    def look() -> None:
        url = capsys.readouterr().out.split()[0]
        with urllib.request.urlopen(url, timeout=120) as page:
            assert page.status == 200

    monkeypatch.setattr("lidarview.viewer.result_views.wait_for_interrupt", look)
    result.view(port=0, browser=False)
    frames = []
    monkeypatch.setattr("lidarview.viewer.server.open_browser", lambda url: True)
    simulate(
        scene, Survey(SENSOR, [(0, 0, 1)], 2), client=cluster_client, on_frame=frames.append,
        live=True,
    )  # fmt: skip
    assert "live page: http://127.0.0.1:" in capsys.readouterr().err
    assert [frame.scan for frame in frames] == [0, 1]
