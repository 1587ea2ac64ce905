"""Withheld points and noise of LAS: left out of scenes, comparisons and views, and counted."""

import numpy as np
import pytest
from click.testing import CliRunner

from lidarfiles.recordings.opening import open_recording
from lidarpool.cli.compare_command import compare as compare_command
from lidarpool.cli.scenario_commands import scene as scene_command
from lidarpool.pages.opened import open_view
from lidarreal import Comparison, compare
from lidarscenario.points.point_scene import scene_from_points
from lidarsim import LidarError, Scene
from lidarsim.scene.files.noise_points import OmittedPoints, usable_points

laspy = pytest.importorskip("laspy", reason="laspy is an extra")

GROUND = np.column_stack([*np.mgrid[0:30, 0:30].reshape(2, -1), np.full(900, 100.0)])
MARKED = np.arange(900) % 3 == 0  # 300 points
GROUND_ONLY = GROUND[~MARKED]


def written(path, point_format=6, version="1.4", points=None, **columns):
    """Write ground, whose marked points are at 500 m and have values in `columns`."""
    las = laspy.LasData(laspy.LasHeader(version=version, point_format=point_format))
    las.header.scales = [0.001] * 3
    high = np.where(MARKED, 500.0, 100.0)
    las.x, las.y, las.z = np.column_stack([GROUND[:, :2], high]).T if points is None else points.T
    for name, values in columns.items():
        las[name] = np.asarray(values, np.uint8)
    las.write(str(path))
    return path


def marks(value, other=0):
    return np.where(MARKED, value, other)


def top_of(path, **options):
    """Return the height of the highest surface of the scene of a cloud, and the notes."""
    notes = []
    scene = scene_from_points(path, report=notes.append, **options)
    return round((scene.bounds + scene.origin)[1, 2]), notes


@pytest.mark.extended(every=5)
@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(
    ("point_format", "columns", "left_out"),
    [
        (6, {"withheld": marks(1)}, "300 withheld points"),
        (1, {"withheld": marks(1)}, "300 withheld points"),
        (6, {"classification": marks(7, 2)}, "300 noise points"),
        (3, {"classification": marks(7, 2)}, "300 noise points"),
        (7, {"classification": marks(18, 2)}, "300 noise points"),
        (
            6,
            {"classification": marks(7, 2), "withheld": np.arange(900) % 6 == 0},
            r"150 withheld points and 150 noise points",
        ),
    ],
)
def test_scenes_and_comparisons_leave_them_out(tmp_path, suffix, point_format, columns, left_out):
    path = written(tmp_path / f"a{suffix}", point_format, **columns)
    top, notes = top_of(path)
    assert top == 100 and sum(left_out in note for note in notes) == 1
    assert "use --keep-noise (keep_noise=True in Python)" in notes[0]
    top, notes = top_of(path, keep_noise=True)
    assert top == 500 and not any("keep_noise" in note for note in notes)
    ground = written(tmp_path / "ground.las", points=GROUND)
    figures = compare(path, ground).figures
    assert figures["distances"]["a_to_b"]["mean_m"] < 1e-6
    assert sum(left_out in note for note in figures["notes"]) == 1
    figures = compare(path, ground, keep_noise=True).figures
    assert figures["distances"]["a_to_b"]["mean_m"] > 100
    assert not any("keep_noise" in note for note in figures["notes"])


@pytest.mark.parametrize(
    ("point_format", "columns"),
    [
        (1, {"classification": marks(18, 2)}),  # reserved before LAS 1.4
        (6, {"synthetic": marks(1)}),
        (6, {"overlap": marks(1)}),
        (6, {"classification": marks(12, 2)}),
        (6, {"user_data": marks(7)}),
    ],
)
def test_other_flags_and_classes_are_points(tmp_path, point_format, columns):
    path = written(tmp_path / "a.las", point_format, **columns)
    top, notes = top_of(path)
    assert top == 500 and not any("keep_noise" in note for note in notes)


def test_views_leave_them_out(tmp_path):
    path = written(tmp_path / "a.laz", classification=marks(7, 2))
    view = open_view(path)
    assert len(view.points) == 600 and "300 noise points (classes 7 and 18)" in view.note
    everything = open_view(path, keep_noise=True)
    assert len(everything.points) == 900 and "skipped" not in everything.note
    for keep_noise, count in ((False, 600), (True, 900)):
        recording = open_recording(path, keep_noise=keep_noise)
        sample = recording.sample(100_000)
        share = len(sample) / 880  # of runs of 22 points
        assert share == pytest.approx(count / 900, abs=0.05)
        assert all(len(values) == len(sample) for values in sample.columns.values())


def test_a_file_of_nothing_else_is_refused(tmp_path):
    path = written(tmp_path / "a.las", withheld=np.ones(900))
    with pytest.raises(LidarError, match=r"has 0: 900 withheld points were skipped"):
        scene_from_points(path)
    with pytest.raises(LidarError, match=r"contains no points, .*900 withheld points were skipped"):
        compare(path, path)
    with pytest.raises(LidarError, match=r"contains no points\..*900 withheld"):
        open_view(path)


def test_the_commands_have_the_option(tmp_path, monkeypatch):
    path = written(tmp_path / "a.las", withheld=marks(1))
    runner = CliRunner()
    for options, top in (([], 100), (["--keep-noise"], 500)):
        out = f"{tmp_path}/{top}.glb"
        arguments = ["points", str(path), out, *options]
        done = runner.invoke(scene_command, arguments, catch_exceptions=False)
        assert ("300 withheld points were skipped" in done.output) == (top == 100)
        scene = Scene.load(out)
        assert round((scene.bounds + scene.origin)[1, 2]) == top
    monkeypatch.setattr(Comparison, "save", lambda *_: [tmp_path / "compare.html"])
    arguments = [str(path), str(path), "--keep-noise", "--json", "--out", str(tmp_path / "out")]
    done = runner.invoke(compare_command, arguments, catch_exceptions=False)
    assert '"points": 900' in done.output


def with_columns(path, names, *values):
    head = "ply\nformat ascii 1.0\nelement vertex 900\n"
    head += "".join(f"property float {name}\n" for name in ("x", "y", "z", *names))
    positions = np.column_stack([GROUND[:, :2], np.where(MARKED, 500.0, 100.0), *values])
    rows = "".join(" ".join(map(repr, row)) + "\n" for row in positions.tolist())
    path.write_text(f"{head}end_header\n{rows}")
    return path


@pytest.mark.extended
@pytest.mark.parametrize(
    ("name", "value", "is_left_out"),
    [
        ("scalar_Classification", 7, True),
        ("classification", 18, True),
        ("Withheld", 1, True),
        ("scalar_WithheldFlag", 1, True),
        ("class", 7, False),  # of a scenario, or of another list of classes
        ("label", 7, False),
    ],
)
def test_columns_of_converted_las_count_alike(tmp_path, name, value, is_left_out):
    path = with_columns(tmp_path / "a.ply", [name], marks(value))
    top, notes = top_of(path)
    assert top == (100 if is_left_out else 500)
    assert any("skipped" in note for note in notes) == is_left_out
    assert top_of(path, keep_noise=True)[0] == 500
    recording = open_recording(path)
    assert len(recording[0]) == (600 if is_left_out else 900)
    assert bool(recording.omission_notes) == is_left_out


def test_numbers_of_what_is_left_out():
    usable, left_out = usable_points({"classification": np.array([2, 7, 18, 7])}, (7,))
    assert usable.tolist() == [True, False, True, False] and left_out == OmittedPoints(0, 2)
    columns = {"withheld": np.array([1, 0, 0, 1]), "classification": np.array([7, 18, 2, 2])}
    usable, left_out = usable_points(columns)
    assert usable.tolist() == [False, False, True, False] and left_out == OmittedPoints(2, 1)
    assert usable_points({"x": np.zeros(3)}) == (None, OmittedPoints())
    assert OmittedPoints().omission_note() == ""
    assert OmittedPoints(1, 0).omission_note() == (
        "1 withheld point was skipped. To keep it, use --keep-noise (keep_noise=True in Python)"
    )


def test_views_of_sweeps_state_what_they_leave_out(tmp_path):
    fields = "FIELDS x y z classification\nSIZE 4 4 4 1\nTYPE F F F U\nCOUNT 1 1 1 1"
    head = f"VERSION .7\n{fields}\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA ascii\n"
    for number in range(2):
        (tmp_path / f"{number}.pcd").write_text(f"{head}1 2 3 2\n4 5 6 7\n7 8 9 18\n")
    view = open_view(tmp_path)
    assert len(view.points) == 2 and "4 noise points (classes 7 and 18)" in view.note
