"""Augmentations in Python: sweeps of a recording, and the transform of a data set."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from tests.made_recordings import made_recording
from tests.recorded_drives import recorded_points, write_pcd_drive

from lidarfiles import open_recording
from lidarfiles.clouds.boxes import SweepBoxes
from lidarreal import Augment, Effects, Insertion, augment
from lidarreal.augmentation.augmenter import Augmenter
from lidarsim import Actor, Fault, LidarError, Track, box, load_sensor
from lidarsim.columns.sweep import Sweep

RAIN = {"rain_mm_h": 50, "visibility_km": 0.2}
COLUMNS = ("intensity", "ring")


@pytest.fixture(scope="module")
def rows():
    return recorded_points(3)


@pytest.fixture(scope="module")
def drive(rows, tmp_path_factory):
    return write_pcd_drive(tmp_path_factory.mktemp("recorded") / "drive", rows)


@pytest.fixture(scope="module")
def points(rows):
    """Arrays of shape (n, 5): x, y, z, intensity and ring."""
    names = ("x", "y", "z", "intensity", "ring")
    return [np.column_stack([sweep[name] for name in names]).astype(np.float32) for sweep in rows]


def test_sweeps_of_a_recording(drive):
    augmented = [*augment(drive, **RAIN)]
    assert [sweep.number for sweep in augmented] == [0, 1, 2]
    for sweep, recorded in zip(augmented, open_recording(drive), strict=True):
        assert set(sweep.columns) == {*recorded.columns, "cause"}
        assert (sweep.columns["cause"] == 1).sum() > 100
        assert (sweep.columns["cause"] == 0).sum() > 0.9 * len(recorded)


def test_sweeps_are_those_of_the_augmenter(drive):
    effects = Effects.load(options={"weather": RAIN})
    augmenter = Augmenter(open_recording(drive, keep_noise=True), effects)
    (sweep,) = augment(drive, effects, sweeps=[2])
    assert np.array_equal(sweep.points, augmenter.sweep(2).sweep.points)


def test_effects_have_several_forms(drive, tmp_path):
    path = tmp_path / "effects.yaml"
    path.write_text("weather: {rain_mm_h: 50, visibility_km: 5}\n")
    given = [
        (None, RAIN),
        ({"weather": RAIN}, {}),
        (path, {"visibility_km": 0.2}),
        (str(path), {"visibility_km": 0.2}),
        (Effects.load(path), {"visibility_km": 0.2}),
        ({"weather": {"rain_mm_h": 50}}, {"visibility_km": 0.2}),
    ]
    results = [next(augment(drive, effects, **weather)).points for effects, weather in given]
    for result in results[1:]:
        assert np.array_equal(result, results[0])


def test_seeds_change_random_numbers(drive):
    first, again, other = (next(augment(drive, seed=seed, **RAIN)) for seed in (1, 1, 2))
    assert np.array_equal(first.points, again.points)
    assert not np.array_equal(first.points, other.points)


def test_models_have_their_data_sheet(drive):
    named = next(augment(drive, model="velodyne/vlp16", **RAIN))
    loaded = load_sensor("velodyne/vlp16", performance="datasheet")
    assert np.array_equal(next(augment(drive, model=loaded, **RAIN)).points, named.points)


def test_boxes_of_recorded_and_inserted_objects(drive):
    recorded = SweepBoxes(
        ("Car 1",),
        ("Car",),
        np.array([4], np.int32),
        np.array([[9.0, 0, 0]]),
        np.array([[0.0, 0, 0, 1]]),
        np.ones((1, 3)),
        np.array([17]),
    )
    opened = open_recording(drive)
    recording = made_recording("drive", 1, lambda number: opened[0].replace(boxes=recorded))
    crate = Insertion(box("crate", (1, 1, 1)), 6, -3)
    (sweep,) = augment(recording, Effects(insertions=(crate,)))
    assert sweep.boxes.names == ("Car 1", "crate")
    assert sweep.boxes.points[0] == 17
    assert sweep.boxes.points[1] > 50
    (sweep,) = augment(recording, **RAIN)
    assert sweep.boxes.names == ("Car 1",)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"rain": 5}, "'rain' is not a field of the weather. Did you mean 'rain_mm_h'"),
        ({"rain_mm_h": -5}, "rain_mm_h"),
        ({"effects": {"scene": "seed"}}, "`scene` cannot be applied to a recording"),
        ({"effects": "nowhere.yaml"}, "nowhere.yaml"),
        ({"model": "velodyne/none"}, "velodyne/none"),
    ],
)
def test_invalid_arguments_are_refused(drive, arguments, words):
    with pytest.raises(LidarError) as refused:
        augment(drive, **arguments)
    assert words in str(refused.value)


@pytest.mark.parametrize("options", [{}, {"model": "velodyne/vlp16"}, {"reference": "drive"}])
def test_arrays_are_augmented(points, drive, options):
    if "reference" in options:
        options = {"reference": drive}
    augmented = Augment(columns=COLUMNS, **options, **RAIN)
    result = augmented(points[0], 7)
    assert result.dtype == np.float32
    assert result.shape[1] == 5
    assert len(result) > len(points[0]) + 100
    assert set(result[:, 4]) == set(range(16))
    kept = {tuple(row) for row in points[0][:, :3].tolist()}
    assert sum(tuple(row) in kept for row in result[:, :3].tolist()) > 0.9 * len(kept)


@pytest.mark.parametrize("with_reference", [False, True])
def test_results_depend_only_on_points_and_seed(points, drive, with_reference):
    reference = {"reference": drive} if with_reference else {}
    one = Augment(columns=COLUMNS, **reference, **RAIN)
    expected = [one(array, seed) for seed, array in enumerate(points)]
    other = pickle.loads(pickle.dumps(Augment(columns=COLUMNS, **reference, **RAIN)))
    for seed in (2, 0, 1):
        assert np.array_equal(other(points[seed], seed), expected[seed])
    assert not np.array_equal(one(points[0], 1), expected[0])


def test_references_have_several_forms(points, drive):
    recording = open_recording(drive, keep_noise=True)
    results = [
        Augment(columns=COLUMNS, reference=reference, **RAIN)(points[1], 3)
        for reference in (drive, str(drive), recording, [*recording])
    ]
    for result in results[1:]:
        assert np.array_equal(result, results[0])


def test_arrays_may_lack_columns_of_the_reference(points, drive):
    """The rings are then determined from the points of the reference."""
    augmented = Augment(reference=drive, **RAIN)
    result = augmented(points[0][:, :4], 3)
    assert result.shape[1] == 4
    assert len(result) > len(points[0]) + 100
    (sweep,) = [Augment(reference=drive, **RAIN)(open_recording(drive)[0], 3)]
    assert len(sweep) > len(points[0]) + 100


def test_sweeps_keep_their_identity(drive):
    recorded = open_recording(drive)[1].replace(
        pose=np.diag([1.0, 1, 1, 1]), job="a", job_number=3, split="train", values={"rain": 1}
    )
    sweep = Augment(**RAIN)(recorded, 5)
    assert isinstance(sweep, Sweep)
    assert (sweep.number, sweep.job, sweep.split) == (1, "a", "train")
    assert sweep.values == {"rain": 1}
    assert np.array_equal(sweep.pose, recorded.pose)
    assert (sweep.columns["cause"] == 1).sum() > 100


def test_insertions_are_relative_to_the_sensor(drive):
    crate = Insertion(box("crate", (1, 1, 1)), 6, -3)
    transform = Augment(Effects(insertions=(crate,)))
    for recorded in open_recording(drive):
        moved = recorded.replace(
            pose=np.array([[0, -1.0, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        )
        sweep = transform(moved)
        assert np.allclose(sweep.boxes.centers[0, :2], [6, -3], atol=0.05)


@pytest.mark.parametrize(
    ("effects", "words"),
    [
        (
            Effects(faults=(Fault("dirt", transmission=0.5, from_s=1),)),
            "faults[0]: A transform augments single sweeps",
        ),
        (
            Effects(actors=(Actor(box("van", (4, 2, 2)), Track([0, 1], [[0, 0, 0], [1, 0, 0]])),)),
            "Actor 'van' moves",
        ),
        ({"noise": {"angle_deg": 0.1}}, "`noise.angle_deg` cannot be simulated"),
    ],
)
def test_effects_must_not_change_over_time(effects, words):
    with pytest.raises(LidarError) as refused:
        Augment(effects)
    assert words in str(refused.value)


def test_arrays_must_match_the_columns(points):
    with pytest.raises(LidarError, match=r"shape \(n, 4\) for x, y, z and intensity"):
        Augment(**RAIN)(points[0])
    with pytest.raises(LidarError, match="must have different names"):
        Augment(columns=("intensity", "intensity"))
    with pytest.raises(LidarError, match="seed"):
        Augment(columns=COLUMNS, **RAIN)(points[0], -1)
    with pytest.raises(LidarError, match="reference contains no sweeps"):
        Augment(reference=[], **RAIN)


def test_tensors_stay_tensors(points):
    torch = pytest.importorskip("torch")
    augmented = Augment(columns=COLUMNS, **RAIN)
    result = augmented(torch.from_numpy(points[0]), 4)
    assert result.dtype == torch.float32
    assert np.array_equal(result.numpy(), augmented(points[0], 4))


@pytest.mark.parametrize("with_reference", [False, True])
def test_sweeps_without_returns_are_unchanged(drive, with_reference):
    augmented = Augment(columns=COLUMNS, reference=drive if with_reference else None, **RAIN)
    empty = augmented(np.zeros((0, 5), np.float32))
    assert (empty.shape, empty.dtype) == ((0, 5), np.float32)
    lost = np.full((3, 5), np.nan)
    assert np.array_equal(augmented(lost), lost, equal_nan=True)
    columns = {"intensity": np.zeros(0, np.uint8), "ring": np.zeros(0, np.uint16)}
    sweep = augmented(Sweep(np.zeros((0, 3)), columns, number=7))
    assert (len(sweep), sweep.number) == (0, 7)
    assert {*sweep.columns} == {"intensity", "ring", "cause"}
    assert sweep.columns["cause"].dtype == np.uint8


def test_errors_name_arguments_instead_of_options(points):
    recording = made_recording("drive", 1, lambda _: Sweep(points[0][:, :3]))
    remedy = "or pass `reflectance=0.3` to assume the same reflectance for all returns."
    with pytest.raises(LidarError) as error:
        Augment(columns=(), **RAIN)(points[0][:, :3])
    assert str(error.value) == (
        "the sweep has no intensity column, so the energies of its returns are unknown. Pass the "
        f"names of the columns as `columns`, including an intensity, {remedy}"
    )
    with pytest.raises(LidarError) as error:
        augment(recording, **RAIN)
    assert str(error.value) == (
        "drive has no intensity column, so the energies of its returns are unknown. Open the "
        f"recording with `open_recording(path, intensity=COLUMN)`, {remedy}"
    )
    assert len(next(augment(recording, reflectance=0.3, **RAIN))) > 0


def test_arrays_are_refused_as_recordings(points):
    with pytest.raises(
        ValueError, match=r"type is ndarray\. To augment sweeps and arrays, use the"
    ):
        augment(points[0], **RAIN)
