"""Warnings of poses, motions and noise that real surveys do not have."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from trimesh import Trimesh, creation
from trimesh.transformations import rotation_matrix

from lidarscenario.campaign.campaign import CampaignSpec
from lidarscenario.campaign.campaign_file import is_campaign
from lidarscenario.plausibility import plausibility_warnings
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.procedural.city import city
from lidarscenes.procedural.paint import paint_scene
from lidarscenes.writers.scene_file import write_scene
from lidarsim import Scanner, Scene, SceneMesh, load_sensor
from raybeam import RayCaster

EXAMPLES = Path(__file__).parents[2] / "examples"
CITY = {"city-drive", "crossing", "crossing-night", "drive"}
SQUARE = np.array([[-100.0, -100, 0], [100, -100, 0], [100, 100, 0], [-100, 100, 0]])
TIMES = np.linspace(0, 10, 101)


def sheet(name: str, scale: tuple[float, float, float], height: float = 0.0) -> SceneMesh:
    return SceneMesh(name, SQUARE * scale + [0, 0, height], np.array([[0, 1, 2], [0, 2, 3]]))


def solid(name: str, mesh: Trimesh, at: tuple[float, float, float] = (0, 0, 0)) -> SceneMesh:
    return SceneMesh(name, np.asarray(mesh.vertices) + at, np.asarray(mesh.faces))


def block(name: str, size: tuple[float, float, float], x: float, y: float) -> SceneMesh:
    return solid(name, creation.box(size), (x, y, size[2] / 2))


def without_bottom(mesh: Trimesh) -> Trimesh:
    mesh.update_faces(mesh.face_normals[:, 2] > -0.5)
    return mesh


def inverted(mesh: Trimesh) -> Trimesh:
    mesh.invert()
    return mesh


def tube(radius_m: float, length_m: float) -> Trimesh:
    mesh = creation.cylinder(radius_m, length_m)
    open_ended = Trimesh(mesh.vertices, mesh.faces[np.abs(mesh.face_normals[:, 2]) < 0.5])
    return open_ended.apply_transform(rotation_matrix(np.pi / 2, [0, 1, 0]))


GROUND = sheet("Ground", (1, 1, 1))
ROAD = sheet("Road", (1, 0.04, 1), -1.0)
TOWN = [
    GROUND,
    block("House", (10, 8, 6), 20, 0),
    solid("Shell", without_bottom(creation.box((10, 8, 6))), (-20, 0, 3)),
    block("Car", (4.5, 1.8, 1.5), 0, 20),
    block("Wall", (30, 0.4, 3), 0, -30),
]
SLAB = [solid("Slab", creation.box((100, 100, 1)), (0, 0, -0.5)), TOWN[1]]
COURTYARD = [
    GROUND,
    *(block(f"East {x}", (2, 22, 12), x, 0) for x in (-10, 10)),
    *(block(f"North {y}", (22, 2, 12), 0, y) for y in (-10, 10)),
]


def warnings_of(folder: Path, meshes: list[SceneMesh] | None = None, **scenario: Any) -> list[str]:
    if meshes:
        write_scene(folder / "scene.glb", Scene.from_meshes(meshes))
        scenario["scene"] = "scene.glb"
    return plausibility_warnings(prepare(Scenario.from_data(scenario, folder=folder), plans=False))


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(
    ("meshes", "position", "warning", "free"),
    [
        (
            TOWN,
            (0, 0, -5),
            "the sensor is below the scene at (0.000, 0.000, -5.000). Check z",
            "[0.0, 0.0, 2.0]",
        ),
        (TOWN, (0, 0, -0.3), "the sensor is below the scene", "[0.0, 0.0, 2.0]"),
        (SLAB, (0, 0, -5), "the sensor is below the scene", "[0.0, 0.0, 1.0]"),
        (SLAB, (0, 0, -0.5), "the sensor is inside the closed body 'Slab'", ""),
        (
            TOWN,
            (20, 0, 2),
            "the sensor is inside the closed body 'House' at (20.000, 0.000, 2.000). It hits",
            "[26.0, 0.0, 2.0]",
        ),
        (TOWN, (-20, 0, 2), "the sensor is inside the closed body 'Shell'", "[-14.0, 0.0, 2.0]"),
        (TOWN, (0, 20, 1), "the sensor is inside the closed body 'Car'", "[0.0, 21.5, 1.0]"),
        (TOWN, (0, -30, 1), "the sensor is inside the closed body 'Wall'", "[0.71, -29.29, 1.0]"),
    ],
    ids=["below", "just below", "slab", "in slab", "house", "no bottom", "car", "wall"],
)
def test_a_sensor_under_the_scene_or_in_a_body(tmp_path, meshes, position, warning, free):
    warnings = warnings_of(tmp_path, meshes, poses=[[*position]])
    assert len(warnings) == 1 and warnings[0].startswith(warning)
    found = f"The nearest free position found is {free}"
    extent = "The body extends from (-50.00, -50.00, -1.00) to (50.00, 50.00, 0.00)"
    assert (found if free else extent) in warnings[0]
    assert "from outside" not in warnings[0]
    if free:
        assert warnings_of(tmp_path, poses=[yaml.safe_load(free)], scene="scene.glb") == []


def test_a_drive_into_a_body_names_body_and_time_and_offers_no_poses(tmp_path):
    into = drive((0, -40, 0, 2), (4, 20, 0, 2)) | {"steps": 1440}
    [warning] = warnings_of(tmp_path, TOWN, **into)
    assert re.match(
        r"the sensor is inside the closed body 'Shell' at \d+ of 24 tested positions, first at "
        r"\(-\d\d\.\d{3}, 0\.000, 2\.000\), 1\.\d+ s after the start\. It hits "
        r"only the back faces of surfaces\. "
        r"The body extends from \(-25\.00, -4\.00, 0\.00\) to \(-15\.00, 4\.00, 6\.00\)",
        warning,
    )
    assert "poses" not in warning


def test_one_bad_position_of_several_is_counted(tmp_path):
    [warning] = warnings_of(tmp_path, TOWN, poses=[[0, 0, 2], [0, 20, 1], [5, 5, 1]])
    assert " at 1 of 3 tested positions, first at (0.000, 20.000, 1.000)" in warning
    assert "The nearest free position found for pose 2 is [0.0, 21.5, 1.0]" in warning
    shifted = {"poses": [[0, 20, 0.5], [5, 5, 0]], "mount": [0, 0, 0.5]}
    [warning] = warnings_of(tmp_path, TOWN, **shifted)
    assert "The nearest free position found for pose 1 is [0.0, 21.5, 0.5]" in warning


@pytest.mark.parametrize(
    ("meshes", "position"),
    [
        (TOWN, (0, 0, 2)),
        ([solid("Hall", creation.box((8, 6, 3)))], (0, 0, 0)),
        ([solid("Hall", inverted(creation.box((8, 6, 3))))], (0, 0, 0)),
        ([ROAD, solid("Tunnel", tube(4, 200))], (0, 0, 1)),
        ([ROAD, solid("Tunnel", inverted(tube(4, 200)))], (0, 0, 1)),
        (COURTYARD, (0, 0, 1.5)),
        ([solid("Part", creation.box((1, 1, 1)), (0, 0, 3))], (0, 0, 0)),
    ],
    ids=["town", "hall", "inward hall", "tunnel", "inward tunnel", "courtyard", "part from below"],
)
def test_rooms_tunnels_and_courtyards_are_no_faults(tmp_path, meshes, position):
    assert warnings_of(tmp_path, meshes, poses=[[*position]]) == []


@pytest.mark.extended
def test_a_sensor_in_the_body_of_an_actor(tmp_path):
    points = [{"time_s": 0, "position": [-20, 5, 0.8]}, {"time_s": 4, "position": [20, 5, 0.8]}]
    write_scene(tmp_path / "car.glb", Scene.from_meshes([block("Car", (4.5, 1.8, 1.5), 0, 0)]))
    car = {"name": "Car 1", "file": "car.glb"}
    drive = {"trajectory": {"points": points}, "steps": 36, "actors": [car]}
    assert warnings_of(tmp_path, TOWN, **drive, mount=[0, 0, 1.9]) == []
    points[0]["position"] = [-20, 5, 0.0]
    points[1]["position"] = [20, 5, 0.0]
    [warning] = warnings_of(tmp_path, TOWN, **drive, mount=[0, 0, 0.8])
    assert warning.startswith("the sensor is inside Car 1 at (")


def test_a_housing_that_a_sensor_does_not_see_is_no_fault(tmp_path):
    """Of the scene or of an actor, for the sensor that does not see it alone."""
    at_car = {"poses": [[0, 20, 1]]}
    [warning] = warnings_of(tmp_path, TOWN, **at_car)
    assert "If the body is the sensor housing, add its name to `unseen` of the sensor" in warning
    assert warnings_of(tmp_path, TOWN, **at_car, sensor={"unseen": ["Car"]}) == []
    sensors = {"one": {"unseen": "Car"}, "other": {"mount": [0, 0, 0.1]}}
    [warning] = warnings_of(tmp_path, TOWN, **at_car, sensors=sensors)
    assert " at 1 of 2 tested positions, first at (0.000, 20.000, 1.100)" in warning
    points = [{"time_s": 0, "position": [-20, 5, 0]}, {"time_s": 4, "position": [20, 5, 0]}]
    drive = {"trajectory": {"points": points}, "steps": 36, "mount": [0, 0, 0.8]}
    drive["actors"] = [{"name": "Robot", "box": [4.5, 1.8, 1.5]}]
    [warning] = warnings_of(tmp_path, TOWN, **drive)
    assert "or add the name to `unseen` of the sensor" in warning
    assert warnings_of(tmp_path, TOWN, **drive, sensor={"unseen": ["Rob*"]}) == []


@pytest.mark.parametrize("sensor", [{}, {"sensor": "velodyne/vlp16"}], ids=["grid", "vlp16"])
def test_noise_above_a_tenth_of_the_range(tmp_path, sensor):
    poses = {"poses": [[0, 0, 2]]}
    [warning] = warnings_of(tmp_path, TOWN, **sensor, **poses, noise={"range_m": 20})
    assert warning.startswith("`noise.range_m` is 20 m, which is more than a tenth of the range (")
    assert warnings_of(tmp_path, TOWN, **sensor, **poses, noise={"range_m": 0.02}) == []
    [warning] = warnings_of(tmp_path, TOWN, **poses, noise={"range_per_m": 0.2})
    assert "`noise.range_per_m` is 0.2" in warning
    [warning] = warnings_of(
        tmp_path, scene="seed", noise={"range_m": 20}
    )  # with poses that were chosen
    assert "`noise.range_m` is 20 m" in warning


BODY = block("Body", (1, 1, 1.5), 0.52, 0)  # its front is 2 cm in front of x = 0
MAST = solid("Mast", creation.cylinder(0.03, 2), (0.1, 0.1, 1))
CLOSE = {"poses": [[0, 0, 1]], "sensor": "velodyne/vlp16"}


def share_of(warning: str) -> float:
    """Return the fraction of the points in a warning about close surfaces."""
    match = re.match(r"(\d+)% of the points are behind surfaces that are closer than", warning)
    assert match, warning
    return float(match[1]) / 100


@pytest.mark.parametrize("mesh", [BODY, MAST], ids=["body", "mast"])
def test_points_behind_surfaces_below_the_minimum_range_are_counted(tmp_path, mesh):
    [warning] = warnings_of(tmp_path, [GROUND, TOWN[1], mesh], **CLOSE)
    assert f"minimum range of 0.4 m, such as {mesh.name!r} at 0." in warning
    assert f"add {mesh.name!r} to `unseen` of the sensor" in warning and "`blocked_deg`" in warning
    scene = Scene.load(tmp_path / "scene.glb")
    cloud = Scanner(scene, load_sensor("velodyne/vlp16")).sweep((0, 0, 1))
    directions = np.asarray(cloud.positions, np.float64) - [0, 0, 1]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.tile([0.0, 0, 1], (len(directions), 1))
    first = RayCaster(mesh.vertices, mesh.faces).cast(origins, directions)
    expected = np.mean(first.distance < 0.4)
    assert expected > 0.05 and share_of(warning) == pytest.approx(expected, abs=0.02)
    assert warnings_of(tmp_path, **CLOSE, scene="scene.glb", mount=[-0.5, -0.5, 0]) == []


@pytest.mark.parametrize(
    "change",
    [
        {"sensor": {"model": "velodyne/vlp16", "unseen": "Body"}},
        {"sensor": {"model": "velodyne/vlp16", "min_range_m": 0}},
        {"materials": [{"objects": "Body", "transparent": "pass"}, {"objects": "*"}]},
    ],
    ids=["housing", "no minimum", "window"],
)
def test_housings_and_windows_in_front_of_a_sensor_are_no_faults(tmp_path, change):
    assert warnings_of(tmp_path, [GROUND, BODY], **(CLOSE | change)) == []


def test_the_body_that_carries_a_sensor_is_close_to_it_alone(tmp_path):
    """The body is an actor that moves with one of two sensors."""
    points = [{"time_s": 0, "position": [-20, 5, 0]}, {"time_s": 4, "position": [20, 5, 0]}]
    body = {"name": "Robot", "box": [0.4, 0.4, 0.8], "trajectory": {"points": points}}
    sensors = {
        "front": {"model": "velodyne/vlp16", "mount": [0.22, 0, 0.5]},
        "above": {"model": "velodyne/vlp16", "mount": [0, 0, 1.5]},
    }
    moving = {"trajectory": {"points": points}, "actors": [body], "sensors": sensors}
    [warning] = warnings_of(tmp_path, TOWN, **moving)
    assert re.match(r"\d\d% of the points of front are behind", warning)
    assert "such as 'Robot' at 0.02" in warning


def drive(*points: tuple[float, ...]) -> dict[str, Any]:
    """Return a trajectory of times, x, y, z, and perhaps yaw."""
    names = ("yaw_deg",)
    poses = [
        {"time_s": t, "position": [x, y, z], **dict(zip(names, yaw, strict=False))}
        for t, x, y, z, *yaw in points
    ]
    return {"trajectory": {"points": poses}, "steps": 36}


def test_speeds_and_angular_rates_that_carriers_do_not_have(tmp_path):
    fast = drive((0, -1000, 5, 2), (1, 1000, 5, 2))
    [warning] = warnings_of(tmp_path, TOWN, **fast)
    assert warning.startswith("the platform moves at 2,000 m/s at 0.5 s, but platforms on the")
    assert warnings_of(tmp_path, TOWN, **drive((0, -20, 5, 2), (4, 20, 5, 2))) == []
    flight = drive((0, -300, 0, 400), (3, 300, 0, 400))  # 200 m/s
    assert warnings_of(tmp_path, TOWN, **flight) == []
    low = drive((0, -300, 0, 10), (3, 300, 0, 10))
    assert "moves at 200 m/s" in warnings_of(tmp_path, TOWN, **low)[0]
    jump = drive((0, -20, 5, 2, 0), (0.1, -19, 5, 2, 170), (4, 20, 5, 2, 0))
    assert (
        "the platform rotates at 1,700 degrees per second" in warnings_of(tmp_path, TOWN, **jump)[0]
    )


def quaternions(yaw: np.ndarray) -> np.ndarray:
    """Return x, y, z, w (k, 4) of yaw angles (k,), radians."""
    zero = np.zeros_like(yaw)
    return np.stack([zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)], axis=1)


STRAIGHT = np.stack([5 * TIMES - 25, 0 * TIMES + 5, 0 * TIMES + 2], axis=1), 0 * TIMES
CIRCLE = (
    np.stack([9 * np.cos(TIMES / 3), 9 * np.sin(TIMES / 3), 0 * TIMES + 2], axis=1),
    TIMES / 3 + np.pi / 2,
)
TURNING = np.tile([0.0, 5, 2], (len(TIMES), 1)), TIMES / 3


@pytest.mark.extended(every=3)
@pytest.mark.parametrize("path", [STRAIGHT, CIRCLE, TURNING], ids=["line", "circle", "standing"])
def test_quaternions_in_another_order(tmp_path, path):
    positions, yaw = path
    scenario = {"trajectory": "way.tum", "steps": 36}
    right = quaternions(yaw)
    np.savetxt(tmp_path / "way.tum", np.column_stack([TIMES, positions, right]))
    assert warnings_of(tmp_path, TOWN, **scenario) == []
    w_first = right[:, [3, 0, 1, 2]]
    np.savetxt(tmp_path / "way.tum", np.column_stack([TIMES, positions, w_first]))
    [warning] = warnings_of(tmp_path, TOWN, **scenario)
    assert "probably in the order w, x, y, z" in warning
    assert re.match(
        r"the z axis of the platform is tilted by \d+ degrees from vertical\. ", warning
    )


@pytest.mark.extended
@pytest.mark.parametrize(("yaw_deg", "side"), [(90, "left"), (-90, "right")])
def test_a_carrier_that_faces_aside_all_along(tmp_path, yaw_deg, side):
    aside = drive((0, -20, 5, 2, yaw_deg), (4, 20, 5, 2, yaw_deg))
    [warning] = warnings_of(tmp_path, TOWN, **aside)
    assert (
        f"the platform constantly faces 90 degrees to the {side} of its direction of travel"
        in warning
    )
    there_and_back = drive((0, -20, 5, 2, 0), (4, 20, 5, 2, 0), (8, -20, 5, 2, 0))
    assert warnings_of(tmp_path, TOWN, **there_and_back) == []


def test_a_trajectory_with_another_axis_up(tmp_path):
    positions = CIRCLE[0][::10, [0, 2, 1]] + [0, 0, 20]
    points = [(t, *p) for t, p in zip(TIMES[::10].tolist(), positions.tolist(), strict=True)]
    warnings = warnings_of(tmp_path, TOWN, **drive(*points))
    assert any("whether y is the up axis of its file" in warning for warning in warnings)
    climb = drive((0, 0, 0, 1), (10, 0, 0, 31))
    assert warnings_of(tmp_path, TOWN, **climb) == []  # of a drone


@pytest.fixture(scope="module")
def with_city(tmp_path_factory) -> Path:
    """Return a folder with the examples and the city that some of them need."""
    folder = tmp_path_factory.mktemp("examples")
    for path in EXAMPLES.iterdir():
        (folder / path.name).symlink_to(path)
    write_scene(folder / "city.glb", paint_scene(city(100_000)))
    return folder


@pytest.mark.extended(every=4)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(path.stem, marks=[pytest.mark.slow] * (path.stem in {"block", *CITY}))
        for path in sorted(EXAMPLES.glob("*.yaml"))
        if path.stem != "warehouse"  # of a file that is not among the examples
    ],
)
def test_examples_have_no_warnings(with_city, name):
    if name == "block":
        pytest.importorskip("pxr")
    path = with_city / f"{name}.yaml"
    scenario = CampaignSpec.load(path).scenario(0) if is_campaign(path) else Scenario.load(path)
    assert scenario is not None
    assert plausibility_warnings(prepare(scenario, plans=False)) == []
