"""The table of columns, columns of one's own, and clouds that hold them."""

from __future__ import annotations

import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarfiles import save_cloud
from lidarpool import simulate
from lidarsim import (
    Cloud,
    Column,
    Fault,
    LidarError,
    Material,
    Mounted,
    Noise,
    Pose,
    Returns,
    Scene,
    SceneMesh,
    Sensor,
    Survey,
    Track,
)
from lidarsim.columns.table import ALWAYS, OPTIONAL, TABLE, columns_in_parts, optional_columns
from lidarsim.simulator.points.batch_points import BatchPoints

# -- the table ------------------------------------------------------------------------------------


def test_the_table_describes_every_column():
    assert next(iter(TABLE)) == "scan" and set(TABLE) >= {"time", "intensity", "class"}
    for name, column in TABLE.items():
        assert column.name == name and column.meaning and not column.meaning.endswith(".")
        assert name == "scan" or hasattr(BatchPoints, column.source or name), name
    assert len({column.in_files for column in TABLE.values()}) == len(TABLE)


def test_columns_are_chosen_by_name_once_and_in_order():
    own = Column("mine", "u1", "", "", lambda returns: 0)
    assert optional_columns([]) == ()
    found = optional_columns(
        ["range", own, "time", "range", own, TABLE["time"], "ring", "channel", "scan"]
    )
    assert [column.name for column in found] == ["range", "mine", "time"]
    assert columns_in_parts(found) == (*ALWAYS, *found)
    assert optional_columns(OPTIONAL) == OPTIONAL


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (["intensty"], r"Unknown column 'intensty'.*'intensity'"),
        (["reflectance of the surface"], r"Available columns:\n  scan, x, y, .*intensity.*"),
        ([Column("time", "u4", "s", "another")], "Two columns have the name 'time'. Rename one"),
        ([Column("a", "u1", "", ""), Column("a", "u2", "", "")], "Two columns have the name 'a'"),
        ([Column("ring", "u1", "", "")], "Two columns have the name 'ring'"),
        ([Column("a", "u1", "", "", file_name="x")], "Two columns have the name 'x'"),
    ],
)
def test_columns_that_cannot_be_chosen(columns, message):
    with pytest.raises(LidarError, match=message):
        optional_columns(columns)


@pytest.mark.parametrize("name", ["", "a b", "1st", "a-b", "../x"])
def test_a_column_is_called_by_an_identifier(name):
    with pytest.raises(LidarError, match=f"must be an identifier, but is '{name}'"):
        Column(name, "u1", "", "")


@pytest.mark.parametrize("name", ["a b", "a\nb", "höhe", "positions", "normals", "colors", "x"])
def test_a_column_that_files_cannot_hold_is_neither_chosen_nor_written(name, tmp_path):
    column = Column("a", "u1", "", "", file_name=name)
    with pytest.raises(LidarError, match=r"in files.*(ASCII letters|Use|Rename)"):
        optional_columns([column])
    with pytest.raises(LidarError, match=r"in files.*(ASCII letters|Use|Rename)"):
        save_cloud(Cloud(np.zeros((1, 3)), {"a": [1]}, (column,)), tmp_path / "c.ply")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("dtype", ["float23", "U5", "O", "bool", "M8[s]", "complex64", "3f4"])
def test_a_column_holds_numbers(dtype):
    with pytest.raises(LidarError, match="must be integer or floating point"):
        Column("a", dtype, "", "")


class BatchStub(SimpleNamespace):
    def __len__(self):
        return 3


@pytest.mark.parametrize(
    ("dtype", "values"),
    [("u1", [0, 7, 255]), ("i2", [-5.0, 0.0, 1.0]), ("f4", [np.nan, 0, np.inf]), ("u8", [0, 1, 2])],
)
def test_a_column_is_made_of_an_attribute_or_by_a_function(dtype, values):
    returns = BatchStub(thing=values)
    for source in ("thing", lambda returns: returns.thing):
        made = Column("a", dtype, "", "", source).make(returns)
        assert made.dtype == np.dtype(dtype)
        np.testing.assert_array_equal(made, values)


@pytest.mark.parametrize(
    ("dtype", "values", "message"),
    [
        ("u1", [0, 1], r"one value for each of the 3 points, but has the shape \(2,\)"),
        ("u1", 5, r"shape \(\)"),
        ("f4", np.zeros((3, 1)), r"shape \(3, 1\)"),
        (
            "u1",
            [0, 1, 256],
            ("contains 0 to 256, but uint8 is limited to 0 to 255. Use a wider type"),
        ),
        ("u4", [-1, 0, 1], "contains -1 to 1"),
        ("i4", [0, 1, np.nan], "contains NaN or infinity, which int32"),
        ("i8", [0, 1, np.inf], "contains NaN or infinity"),
    ],
)
def test_values_that_do_not_fit_their_column(dtype, values, message):
    with pytest.raises(LidarError, match=message):
        Column("a", dtype, "", "", lambda returns: values).make(BatchStub())


# -- clouds ---------------------------------------------------------------------------------------


def cloud_of(count=5):
    columns = {"scan": np.arange(count) // 2, "object": np.arange(count) % 3, "mine": [0.5] * count}
    return Cloud(np.arange(3.0 * count).reshape(count, 3), columns)


def test_a_cloud_gives_its_columns_in_their_types():
    cloud = cloud_of()
    assert len(cloud) == 5
    assert cloud.scan.dtype == np.int32 == cloud["object"].dtype
    assert cloud.mine.tolist() == cloud["mine"].tolist() == [0.5] * 5
    assert [c.name for c in cloud.table] == ["scan", "object", "mine"]
    assert cloud.table[0] is TABLE["scan"] and cloud.table[2].dtype == "<f8"
    assert cloud.bounds.tolist() == [[0, 1, 2], [12, 13, 14]]
    again = pickle.loads(pickle.dumps(cloud))
    assert np.array_equal(again.positions, cloud.positions)
    assert again.scan.tolist() == [0, 0, 1, 1, 2]
    empty = Cloud(np.empty((0, 3)), {"scan": []})
    assert empty.bounds.tolist() == [[0, 0, 0], [0, 0, 0]]
    assert list(empty.chunks()) == [] and empty.scan.dtype == np.int32


def test_a_column_that_is_not_there():
    with pytest.raises(
        KeyError,
        match=(
            r"column 'time'. The columns are \['scan', 'object', "
            r"'mine'\]"
        ),
    ):
        cloud_of()["time"]
    with pytest.raises(AttributeError, match="no attribute or column 'time'"):
        _ = cloud_of().time
    assert not hasattr(cloud_of(), "__array_interface__")


def test_numpy_takes_a_cloud_as_positions():
    cloud = cloud_of()
    assert np.shares_memory(np.asarray(cloud), cloud.positions)
    assert np.asarray(Cloud(np.ones((2, 3), np.float32), {})).dtype == np.float64
    assert np.asarray(cloud, np.float32).dtype == np.float32
    assert np.linalg.norm(cloud, axis=1).shape == (5,)


def test_points_are_selected_as_rows_of_an_array():
    cloud = cloud_of()
    assert np.shares_memory(cloud[1:3].positions, cloud.positions)
    for rows in (slice(1, 3), [1, 2], np.array([2, 1]), cloud.scan == 1, [-1], [], cloud.scan < 0):
        some = cloud[rows]
        index = np.arange(5)[rows] if len(some) else np.arange(0)
        assert some.positions.tolist() == cloud.positions[index].tolist()
        assert some.mine.tolist() == cloud.mine[index].tolist() and some.scan.dtype == np.int32
    assert len(cloud.head()) == len(cloud.head(9)) == 5 and len(cloud.head(2)) == 2


@pytest.mark.parametrize("key", [2, [9], 0.5, [0.5], None, np.ones((5, 3), bool), [True], True])
def test_what_selects_no_points(key):
    with pytest.raises(LidarError, match=r"with a slice such as cloud\[:100\], a mask"):
        cloud_of()[key]


def test_a_notebook_shows_the_columns_and_the_first_points():
    html = Cloud(np.ones((7, 3)), {"range": np.full(7, 0.5), "mine": np.zeros(7)})._repr_html_()
    assert "7 points" in html and html.count("<tr>") == 2 + 5
    assert "<td>float32</td>" in html and "<td>0.5</td>" in html and "<td>mine</td>" in html
    assert "0 points" in Cloud(np.empty((0, 3)), {})._repr_html_()


def test_a_column_of_ones_own_is_held_to_its_description():
    own = (Column("mine", "uint8", "dB", "how loud"),)
    cloud = Cloud(np.zeros((2, 3)), {"mine": [1, 2]}, own)
    assert cloud.mine.dtype == np.uint8 and cloud.table == own
    assert cloud[1:2].table == own
    with pytest.raises(LidarError, match=r"'mine' must .* but contains 1 to 256"):
        Cloud(np.zeros((2, 3)), {"mine": [1, 256]}, own)


@pytest.mark.filterwarnings("ignore:invalid value encountered in cast")
@pytest.mark.parametrize(
    ("positions", "columns", "message"),
    [
        (np.zeros((5, 2)), {}, r"must have the shape \(n, 3\), but have \(5, 2\)"),
        (np.zeros(3), {}, r"have \(3,\)"),
        ([[np.nan, 0, 0]], {}, "NaN or infinite"),
        (np.full((1, 3), np.inf, np.float32), {}, "NaN or infinite"),
        (
            np.zeros((2, 3)),
            {"scan": [1]},
            r"'scan' must have one value for each of the 2 points, but has the shape \(1,\)",
        ),
        (np.zeros((2, 3)), {"scan": [[1, 2]]}, r"shape \(1, 2\)"),
        (
            np.zeros((1, 3)),
            {"channel": [65_536]},
            "'channel' must .* 0 to 65535, but contains 65536",
        ),
        (np.zeros((1, 3)), {"scan": [2**31]}, "'scan' must .* contains 2147483648"),
        (np.zeros((1, 3)), {"object": [0.5]}, "'object' must contain whole"),
        (np.zeros((1, 3)), {"time": [np.nan]}, "'time' must .* contains nan"),
    ],
)
def test_arrays_that_are_no_cloud(positions, columns, message):
    with pytest.raises(LidarError, match=message):
        Cloud(positions, columns)


@given(st.integers(0, 20), st.integers(1, 25))
def test_chunks_are_the_cloud(count, points):
    cloud = cloud_of(count)
    chunks = list(cloud.chunks(points))
    assert all(len(chunk) == points for chunk in chunks[:-1])
    assert len(chunks) == -(-count // points)
    if chunks:
        joined = Cloud.concatenate(chunks)
        assert np.array_equal(joined.positions, cloud.positions)
        for name, values in cloud.columns.items():
            assert np.array_equal(joined[name], values) and joined[name].dtype == values.dtype


# -- surfaces and origins -------------------------------------------------------------------------

SURFACE = ["normal_x", "normal_y", "normal_z", "incidence_deg", "origin_x", "origin_y", "origin_z"]


def vectors(cloud, name):
    """Return three columns of a cloud as (n, 3)."""
    return np.stack([cloud[f"{name}_{axis}"] for axis in "xyz"], axis=1)


@pytest.mark.extended
@pytest.mark.parametrize("far_m", [0.0, 500_000.0])
def test_normals_incidence_and_origins_of_a_ramp(cluster_client, far_m):
    # A plane that rises to the east by 30 degrees, and a sensor that drives 3 m above it.
    slope = np.tan(np.radians(30))
    x = np.array([-90.0, 90, 90, -90])
    corners = np.stack([x + far_m, [-90.0, -90, 90, 90], x * slope], axis=1)
    scene = Scene.from_meshes([SceneMesh("Ramp", corners, [[0, 2, 1], [0, 2, 3]])])
    assert scene.origin.any() == bool(far_m)
    track = Track([0, 1], np.array([[far_m, 0, 3], [far_m + 5, 0, 3 + 5 * slope]]) - scene.origin)
    lever = Pose((0.4, 0, 0))
    sensor = Sensor.grid(36, 8, 20.0)
    survey = Survey(
        sensors=[Mounted(sensor, lever)],
        trajectory=track,
        steps=36,
        columns=["time", *SURFACE],
        precision_m=1e-4,
    )
    cloud = simulate(scene, survey, client=cluster_client).cloud
    assert len(cloud) > 30
    # One triangle winds the other way: normals are on the side that the sensor sees.
    np.testing.assert_allclose(
        vectors(cloud, "normal"), np.tile([-0.5, 0, np.sqrt(0.75)], (len(cloud), 1)), atol=1e-6
    )
    seconds = cloud["time"] / 1e9
    start = np.stack([far_m + 5 * seconds, 0 * seconds, 3 + 5 * slope * seconds], axis=1)
    np.testing.assert_allclose(vectors(cloud, "origin") - start, [lever.position] * len(cloud),
                               atol=1e-6)  # fmt: skip
    ahead = np.asarray(cloud) - vectors(cloud, "origin")
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    expected = np.degrees(np.arccos(-(ahead * vectors(cloud, "normal")).sum(axis=1)))
    np.testing.assert_allclose(cloud["incidence_deg"], expected, atol=0.05)
    assert np.ptp(expected) > 30


@pytest.mark.extended
def test_normals_and_origins_in_the_sensors_axes(cluster_client):
    half = np.sqrt(0.5)
    track = Track([0, 1], [[0, 0, 1], [2, 1, 1]], [[0, 0, 0, 1], [0, 0, half, half]])
    mounted = Mounted(Sensor.grid(360, 4), Pose((1, 0, 0.5), 30.0, 10.0), "front")
    survey = Survey(
        sensors=[mounted], trajectory=track, steps=72, columns=SURFACE, precision_m=1e-4
    )
    world = simulate(Scene.seed(), survey, client=cluster_client).cloud
    inside = simulate(
        Scene.seed(), replace(survey, coordinates="sensor"), client=cluster_client
    ).cloud
    # Scalar products of rays and normals, and lengths, are the same in all axes.
    for axis in "xyz":
        np.testing.assert_array_equal(inside[f"origin_{axis}"], 0)
    np.testing.assert_array_equal(inside["incidence_deg"], world["incidence_deg"])
    products = []
    for cloud in (world, inside):
        ahead = np.asarray(cloud, np.float64) - vectors(cloud, "origin")
        products.append((ahead * vectors(cloud, "normal")).sum(axis=1))
    np.testing.assert_allclose(*products, atol=0.02)
    # The poses of the carrier bring them to the world.
    for row in range(0, len(world), 97):
        pose = survey.pose(int(world["scan"][row]))
        np.testing.assert_allclose(
            pose.rotation @ vectors(inside, "normal")[row], vectors(world, "normal")[row], atol=0.03
        )


@pytest.mark.extended
def test_what_is_no_surface_has_neither_normal_nor_incidence(cluster_client):
    survey = Survey(
        Sensor.grid(720, 16, 30.0, step_deg=360), poses=[(0, 0, 1)], steps=1, rain_mm_h=80,
        columns=["cause", *SURFACE], noise=Noise(detection_range_m=60),
        returns=Returns("all", subrays=7, divergence_mrad=3),
    )  # fmt: skip
    cloud = simulate(Scene.seed(), survey, client=cluster_client).cloud
    in_air = cloud["cause"] > 0
    assert 10 < in_air.sum() < len(cloud)
    for name in SURFACE[:4]:
        np.testing.assert_array_equal(np.isnan(cloud[name]), in_air)
    assert np.isfinite(vectors(cloud, "origin")).all()


@pytest.mark.extended
def test_a_ghost_has_no_normal_and_a_frozen_sensor_takes_normals_along(cluster_client):
    mirror = SceneMesh("Mirror", [[5, -9, -9], [5, 9, -9], [5, 9, 9.0]], [[0, 1, 2]])
    behind = SceneMesh("Wall", [[-5, -9, -9], [-5, 9, -9], [-5, 9, 9.0]], [[0, 1, 2]])
    scene = Scene.from_meshes([mirror, behind])
    survey = Survey(
        Sensor.grid(360, 8, step_deg=360), poses=[(0, 0, 0)], steps=1,
        columns=["cause", *SURFACE], returns=Returns("all"),
        materials=[Material("Mirror", 0.3, specular_reflectance=1), Material("*")],
    )  # fmt: skip
    cloud = simulate(scene, survey, client=cluster_client).cloud
    ghosts = cloud["cause"] == 5
    assert ghosts.sum() > 20
    np.testing.assert_array_equal(np.isnan(vectors(cloud, "normal")).any(axis=1), ghosts)

    # The sensor turns by 90 degrees in a second, and repeats its first sweep from then on.
    half = np.sqrt(0.5)
    track = Track([0, 1], [[0, 0, 0], [0, 0, 0]], [[0, 0, 0, 1], [0, 0, half, half]])
    frozen = Survey(
        Sensor.grid(360, 8, step_deg=360), trajectory=track, steps=10, columns=SURFACE,
        faults=[Fault("frozen", 0.15)],
    )  # fmt: skip
    cloud = simulate(Scene.from_meshes([behind]), frozen, client=cluster_client).cloud
    first, last = (cloud[cloud["scan"] == scan] for scan in (1, 9))
    assert len(first) == len(last) > 20
    turn = frozen.pose(9).rotation @ frozen.pose(1).rotation.T
    for columns in ("normal", "origin"):
        expected = vectors(first, columns) @ turn.T
        np.testing.assert_allclose(vectors(last, columns), expected, atol=1e-6)
    assert np.abs(vectors(last, "normal") - vectors(first, "normal")).max() > 0.9


def test_a_vector_is_chosen_as_a_whole():
    with pytest.raises(LidarError, match="normal_x, normal_y, normal_z form a vector"):
        optional_columns(["normal_z"])
    assert len(optional_columns(SURFACE)) == 7
