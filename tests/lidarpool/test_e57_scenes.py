"""E57 files of other programs as scenes: missing values, types, limits and poses."""

import numpy as np
import pytest

from lidarfiles.recordings.opening import open_recording
from lidarpool.pages.opened import open_view
from lidarscenario.points.point_scene import scene_from_points
from lidarsim import LidarError
from lidarsim.columns.sweep import Sweep

pytest.importorskip("pye57", reason="pye57 is an extra")

from tests.e57_files import write_scans

Y, Z = (axis.ravel() for axis in np.mgrid[-2:2:30j, 0:3:30j])
COUNT = len(Y)
ODD = np.arange(COUNT) % 2  # every second point
GRAY = 188  # half of the light, as without colors


def wall(x=5.0, zeros=0):
    """Fields of a wall across x, and of pulses without a return at (0, 0, 0)."""
    nothing = np.zeros(zeros)
    axes = np.full(COUNT, x), Y, Z
    return {
        f"cartesian{axis}": (np.r_[values, nothing], "double")
        for axis, values in zip("XYZ", axes, strict=True)
    }


def colors(values, kind=(0, 255)):
    return {f"color{name}": (values, kind) for name in ("Red", "Green", "Blue")}


def intensities(values, kind="single"):
    return {"intensity": (values, kind)}


def limits(low, high):
    return {"intensityMinimum": low, "intensityMaximum": high}


def pose(x=0.0, quaternion=(1.0, 0.0, 0.0, 0.0)):
    return {
        "rotation": dict(zip("wxyz", quaternion, strict=True)),
        "translation": {"x": x, "y": 0.0, "z": 0.0},
    }


def scene_and_notes(path, scans, **options):
    notes = []
    write_scans(path, scans)
    scene = scene_from_points(path, voxel_m=0.01, report=notes.append, **options)
    return scene, [note.removeprefix(f"{path}").lstrip(": ") for note in notes]


def reds(scene):
    """Return the mean red of the surfels, and their x."""
    centers = scene.vertices[scene.faces].mean(axis=1) + scene.origin
    (mesh,) = scene.meshes()
    return mesh.colors.mean_colors()[:, 0].astype(int), centers[:, 0]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.e57"


def test_pulses_without_a_return_are_left_out_with_a_note(path):
    scans = [{"fields": wall(zeros=600), "pose": pose(10.0)}]
    scene, notes = scene_and_notes(path, scans)
    np.testing.assert_allclose(scene.bounds[:, 0], 15, atol=1e-6)
    assert notes == [f"600 points of {path} at the origin were skipped as pulses without a return"]


@pytest.mark.parametrize("state", ["cartesianInvalidState", "sphericalInvalidState"])
def test_invalid_points_are_left_out(path, state):
    fields = wall()
    x, kind = fields["cartesianX"]
    fields["cartesianX"] = (np.where(ODD, 400.0, x), kind)
    scene, _ = scene_and_notes(path, [{"fields": fields | {state: (2 * ODD, (0, 2))}}])
    np.testing.assert_allclose(scene.bounds[:, 0], 5, atol=1e-6)


def test_invalid_colors_do_not_darken(path):
    fields = wall() | colors(np.where(ODD, 0, 200)) | {"isColorInvalid": (ODD, (0, 1))}
    scene, notes = scene_and_notes(path, [{"fields": fields}])
    red, _ = reds(scene)
    assert (red == 200).all()
    assert notes == [
        f"{COUNT // 2} of {COUNT} points have no color. Surfels of such points have the mean color "
        "of their neighbors, or are gray."
    ]
    view = open_view(path).points
    assert set(np.asarray(view.values("red", slice(None))).tolist()) == {200, GRAY}


def test_invalid_intensities_do_not_darken(path):
    flag = {"isIntensityInvalid": (ODD, (0, 1))}
    fields = wall() | intensities(np.where(ODD, 0.0, 0.5)) | flag
    scene, notes = scene_and_notes(path, [{"fields": fields}])
    red, _ = reds(scene)
    assert (red == 255).all(), "all others are equal, and the 99th percentile is white"
    assert notes[0].startswith(f"{COUNT // 2} of {COUNT} points have no intensity.")
    read = open_recording(path)[0].intensity
    np.testing.assert_array_equal(np.isnan(read), ODD == 1)


def test_colors_that_are_all_invalid_are_no_colors(path):
    fields = wall() | colors(np.zeros(COUNT)) | {"isColorInvalid": (np.ones(COUNT), (0, 1))}
    scene, notes = scene_and_notes(path, [{"fields": fields}])
    assert scene.meshes()[0].colors is None and notes == []


@pytest.mark.parametrize(
    ("value", "kind", "stated"),
    [
        (51_400, (0, 65_535), None),
        (51_400, (0, 65_535), 65_535),
        (200, (0, 255), 255),
        (200, (0, 65_535), 255),  # bytes in 16 bits
        (802, (0, 1023), None),
        (200 / 255, "single", None),
        (200.0, "single", None),
        (200 / 255, "double", 1.0),
    ],
)
def test_colors_of_all_types_are_read(path, value, kind, stated):
    scan = {"fields": wall() | colors(np.full(COUNT, value), kind)}
    if stated is not None:
        names = [f"color{name}" for name in ("Red", "Green", "Blue")]
        scan["colorLimits"] = {f"{name}Minimum": type(stated)(0) for name in names}
        scan["colorLimits"] |= {f"{name}Maximum": stated for name in names}
    scene, _ = scene_and_notes(path, [scan])
    assert (reds(scene)[0] == 200).all()


def test_dark_colors_of_16_bits_stay_dark(path):
    scene, _ = scene_and_notes(
        path, [{"fields": wall() | colors(np.full(COUNT, 250), (0, 65_535))}]
    )
    assert (reds(scene)[0] == 1).all()


def test_rows_beyond_16_bits_and_below_zero_are_read(path):
    rows = np.arange(COUNT) + 70_000
    grid = {"rowIndex": (rows, (0, 1 << 20)), "columnIndex": (-rows, (-(1 << 20), 0))}
    scene, _ = scene_and_notes(path, [{"fields": wall() | grid}])
    np.testing.assert_allclose(scene.bounds[:, 0], 5, atol=1e-6)
    columns = open_recording(path)[0].columns
    np.testing.assert_array_equal(columns["row"], rows)
    np.testing.assert_array_equal(columns["column"], -rows)


def test_a_zero_quaternion_is_no_rotation_with_a_note(path):
    scans = [{"fields": wall(), "pose": pose(10.0, (0.0, 0.0, 0.0, 0.0)), "name": "hall"}]
    scene, notes = scene_and_notes(path, scans)
    np.testing.assert_allclose(scene.bounds[:, 0], 15, atol=1e-6)
    expected = "has a zero quaternion in the pose of scan 1 ('hall'), so the scan is not rotated"
    recording = open_recording(path)
    assert notes == [expected] and recording.notes == (f"{path} {expected}",)
    np.testing.assert_array_equal(recording.poses([0])[0][:3, :3], np.eye(3))


def test_a_quaternion_is_read_by_names_and_of_any_length(path):
    turned = pose(0.0, (3.0, 0.0, 0.0, 3.0))  # by 90 degrees about z
    turned["rotation"] = dict(reversed(turned["rotation"].items()))
    scene, _ = scene_and_notes(path, [{"fields": wall(), "pose": turned}])
    np.testing.assert_allclose(scene.bounds[:, 1], 5, atol=1e-6)


def test_a_scan_without_coordinates_is_named(path):
    write_scans(path, [{"fields": intensities(np.ones(COUNT))}])
    with pytest.raises(LidarError, match=r"scan 1 \('scan'\) has neither Cartesian nor spherical"):
        scene_from_points(path)


@pytest.mark.parametrize("quantity", ["colors", "intensities"])
@pytest.mark.parametrize("are_zero", [False, True])
def test_what_one_of_two_scans_lacks_is_gray(path, quantity, are_zero):
    if quantity == "colors":
        there, zeros = colors(np.full(COUNT, 200)), colors(np.zeros(COUNT))
    else:
        there, zeros = intensities(np.full(COUNT, 7.0)), intensities(np.zeros(COUNT))
    scans = [{"fields": wall() | there}, {"fields": wall(50.0) | (zeros if are_zero else {})}]
    scene, notes = scene_and_notes(path, scans)
    red, x = reds(scene)
    assert (red[x < 10] == (200 if quantity == "colors" else 255)).all()
    assert (red[x > 10] == GRAY).all()
    assert notes[0].startswith(f"{COUNT:,} of {2 * COUNT:,} points have no {quantity[:5]}")


def test_intensities_stay_with_their_scan_in_comparisons(path):
    write_scans(path, [{"fields": wall()}, {"fields": wall() | intensities(np.full(COUNT, 7.0))}])
    recording = open_recording(path)
    joined = Sweep.concatenate([*recording])
    np.testing.assert_array_equal(joined.intensity, np.repeat([np.nan, 7.0], COUNT))


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ((0.0, 1.0), (0.0, 255.0)),
        ((0, 255), (0, 65_535)),
        ((0, 1023), (0, 4095)),
        ((-2048, 2047), (0, 1)),
        ((0.1, 0.7), (10.0, 70.0)),
    ],
)
def test_scans_with_other_limits_have_the_same_scale(path, first, second):
    scans = []
    for x, (low, high) in ((5.0, first), (50.0, second)):
        # The lower half is bright, the upper half has half of the light.
        values = np.where(Z < 1.5, high, (low + high) / 2)
        fields = wall(x) | intensities(values)
        scans.append({"fields": fields, "intensityLimits": limits(low, high)})
    scene, notes = scene_and_notes(path, scans)
    red, x = reds(scene)
    for side in (x < 10, x > 10):
        assert set(red[side].tolist()) == {GRAY, 255}
    assert notes == [
        "specifies intensityLimits, so its intensities were scaled to the range 0 to 1"
    ]
    read = [sweep.intensity for sweep in open_recording(path)]
    np.testing.assert_allclose(*read, atol=1e-6)


def test_lowest_and_highest_values_as_limits_are_no_other_scale(path):
    """Many programs state these as the limits of each scan."""
    scans = [
        {
            "fields": wall(x) | intensities(np.where(Z < 1.5, high, high / 2)),
            "intensityLimits": limits(high / 2, high),
        }
        for x, high in ((5.0, 0.8), (50.0, 0.4))
    ]
    scene, notes = scene_and_notes(path, scans)
    red, x = reds(scene)
    assert set(red[x < 10].tolist()) == {GRAY, 255} and notes == []
    assert red[x > 10].max() == GRAY


def test_scans_with_and_without_limits_are_noted(path):
    scans = [
        {"fields": wall() | intensities(np.ones(COUNT))},
        {
            "fields": wall(50.0) | intensities(np.ones(COUNT)),
            "intensityLimits": limits(-2048, 2047),
        },
    ]
    _, notes = scene_and_notes(path, scans)
    assert notes == [
        "has scans with and without intensityLimits, so their intensities are used as stored"
    ]


@pytest.mark.parametrize("stated", [False, True])
def test_negative_intensities_of_leica_begin_at_zero(path, stated):
    values = np.where(Z < 1.5, 2047, 0)
    values[0] = -2048
    scan = {"fields": wall() | intensities(values, (-2048, 2047))}
    if stated:
        scan["intensityLimits"] = limits(-2048, 2047)
    scene, notes = scene_and_notes(path, [scan])
    red, _ = reds(scene)
    assert set(red.tolist()) == {0, GRAY, 255}
    assert len(notes) == stated
