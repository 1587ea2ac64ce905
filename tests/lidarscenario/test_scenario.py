"""Scenario files: defaults, what they build, and a message for each way to get one wrong."""

import json
import re
from datetime import UTC, datetime
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from trimesh.exchange.gltf import export_glb

from lidarfiles.identity.fingerprint import fingerprint
from lidarscenario import Job
from lidarscenario.advice import advice
from lidarscenario.demo import demo_scenario
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenario.static_scene import SceneCache
from lidarsim import LidarError, Noise, Pose, Returns, Scene, SceneInstance, Sensor, Survey, box
from lidarsim.media.materials import MaterialTable, SurfaceKinds

EXAMPLES = Path(__file__).parents[2] / "examples"
DEFAULT = Survey(Sensor.grid(), poses=[(0, 0, 1), (0, 0, 2), (0, 0, 3)], keep_every=5)


@pytest.fixture
def scenario(tmp_path):
    """Return a function that loads a scenario from its text."""

    def load(text):
        path = tmp_path / "s.yaml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return Scenario.load(path)

    return load


@pytest.fixture
def crate(tmp_path):
    """Write crate.stl, a box of 2 x 4 x 6 m about the origin."""
    mesh = trimesh.creation.box((2, 4, 6))
    (tmp_path / "crate.stl").write_bytes(mesh.export(file_type="stl"))
    return tmp_path / "crate.stl"


def everything(loaded):
    """Build all that a scenario describes."""
    built = prepare(loaded)
    return built.scene, built.survey, built.job.planning


@pytest.mark.parametrize("source", ["python", "file"])
def test_the_survey_of_the_demo(source):
    loaded = {
        "python": demo_scenario,
        "file": lambda: Scenario.load(EXAMPLES / "seed.yaml"),
    }[source]()
    scene, survey, planning = everything(loaded)
    assert fingerprint(survey) == fingerprint(DEFAULT)
    assert (survey.scan_count, survey.ray_count, len(scene.faces)) == (108, 120_000, 76_800)
    assert (planning.start, planning.target) == ((25, 25), (-30, -20))
    np.testing.assert_allclose(planning.radii, 2.0, atol=1e-12)
    centers = [(-20, -20), (20, -20), (-20, 20), (20, 20), (-10, -5), (5, 5)]
    np.testing.assert_allclose(planning.centers, centers, atol=1e-12)
    numbers = (planning.trials, planning.particles, planning.iterations, planning.seed)
    assert numbers == (100, 1000, 300, 0)
    pool = loaded.pool
    assert (pool.queue_capacity, pool.collectors, pool.backend) == (10, 2, "auto")


@pytest.mark.parametrize("scene", ["seed", {"preset": "seed"}, {"preset": "seed", "files": []}])
def test_the_objects_of_the_demo_come_without_its_thinning_and_planning(scene):
    built = prepare(Scenario.from_data({"scene": scene}))
    assert built.scene.names == ("Sphere", "Vase", "Bell", "Pawn", "Spindle", "Bowl")
    assert (built.survey.keep_every, built.survey.precision_m, built.job.planning) == (
        1,
        0.001,
        None,
    )
    assert [pose.position[2] for pose in built.survey.poses] == [1, 2, 3]


@pytest.mark.parametrize("scene", ["", "scene:", "scene: {}", "scene: []", "scene: {files: []}"])
def test_without_a_scene_nothing_is_made_up(scenario, tmp_path, scene):
    text = f"{scene}\nposes: [[0, 0, 1]]\n"
    with pytest.raises(LidarError) as raised:
        prepare(scenario(text))
    assert str(raised.value) == (
        f"{tmp_path / 's.yaml'}: The scenario has no scene. Add mesh files as `scene.files`, or "
        "`scene: seed` for the six objects of `lidarpool demo`."
    )
    actors = "actors: [{name: Crate, box: [2, 2, 2], at: [6, 0, 0]}]"
    with pytest.raises(LidarError, match=r"has actors, but no stationary object\. Add"):
        prepare(scenario(text + actors))


LANE = "{points: [{time_s: 0, position: [-8, 0, 1]}, {time_s: 9, position: [40, 0, 1]}]%s}"


@pytest.mark.parametrize(
    ("text", "rectangle"),
    [
        ("poses: [[0, 0, 1], [4, 3, 1]]", [-5, -5, 9, 8]),
        (
            "poses: [[0, 0, 1]]\nactors: [{name: A, box: [1, 1, 1], at: [9, 2, 0]}, "
            "{name: B, box: [1, 1, 1], at: {position: [0, -7, 0], yaw_deg: 9}}]",
            [-5, -12, 14, 7],
        ),
        ("trajectory: " + LANE % "", [-13, -5, 45, 5]),
        ("trajectory: " + LANE % ", start_s: 3, duration_s: 1.5", [3, -5, 21, 5]),
        (
            "poses: [[0, 20, 1]]\nactors: [{name: A, box: [1, 1, 1], trajectory: "
            + LANE % ", surfaces: Ground, beyond: hold"
            + "}]",
            [-13, -5, 45, 25],
        ),
    ],
)
def test_the_ground_lies_under_poses_trajectories_and_actors(scenario, text, rectangle):
    built = prepare(scenario(f"scene: {{ground: {{height_m: -1}}}}\n{text}"))
    scene = built.scene
    assert scene.names == ("Ground",)
    (bounds,) = scene.object_bounds + scene.origin
    assert [*bounds[0], *bounds[1]] == pytest.approx([*rectangle[:2], -1, *rectangle[2:], -1])
    assert (built.survey.keep_every, built.job.planning) == (1, None)
    wide = text.replace("poses", "scene: {ground: {margin_m: 50}}\nposes")
    if wide != text:
        scene = prepare(scenario(wide)).scene
        assert np.ptp(scene.bounds, axis=0)[:2] == pytest.approx(
            np.add([rectangle[2] - rectangle[0], rectangle[3] - rectangle[1]], 90)
        )


@pytest.mark.parametrize("source", ["file: path.csv", LANE.strip("{}") % ""])
def test_a_translation_shifts_all_positions_of_a_trajectory(scenario, tmp_path, source):
    (tmp_path / "path.csv").write_text("time_s,x,y,z\n0,-8,0,1\n9,40,0,1\n")
    text = "scene: seed\nposes: [[0, 0, 1]]\nactors: [{name: A, box: [1, 1, 1], trajectory: {%s}}]"
    shifted = f"{source}, translation: [2, 1.5, -0.25]"
    tracks = [
        prepare(scenario(text % fields)).scene.actors[0].trajectory for fields in (source, shifted)
    ]
    assert np.allclose(tracks[1].positions - tracks[0].positions, (2, 1.5, -0.25))


def test_a_ground_under_nothing_is_refused(scenario):
    with pytest.raises(LidarError, match=r"s\.yaml: The extent of `scene\.ground` .* Add `poses`"):
        prepare(scenario("scene: {ground: {}}"))


def test_scenarios_share_a_scene_if_their_ground_is_the_same():
    """Poses within the scene leave the ground as it is."""
    cache = SceneCache()
    scene = {"preset": "seed", "ground": {}}
    scenarios = [Scenario.from_data({"scene": scene, "poses": [[x, 0, 1]]}) for x in (0, 3, 30, 0)]
    inside, beside, outside, again = (prepare(one, cache=cache).scene for one in scenarios)
    assert inside is beside is again
    assert outside.names == inside.names and outside.vertices.shape == inside.vertices.shape
    ends = [(scene.bounds + scene.origin)[1, 0] for scene in (inside, outside)]
    assert ends == pytest.approx([27, 35])


def test_a_model_and_a_unit_of_it(tmp_path):
    (tmp_path / "unit.csv").write_text(
        "Channel,Elevation,Azimuth\n" + "\n".join(f"{i},{16.1 - i},0" for i in range(1, 33))
    )
    (tmp_path / "s.yaml").write_text(
        "scene: seed\nsensor: {calibration: unit.csv, rate_hz: 20, max_range_m: 60, step_deg: 30}\n"
        "steps: 12\n"
    )
    survey = prepare(Scenario.load(tmp_path / "s.yaml")).survey
    sensor = survey.sensor
    assert (sensor.name, sensor.max_range_m) == ("Hesai PandarXT-32, unit.csv", 60)
    assert survey.ray_count == 3 * 32 * 1000, "one turn from each pose"
    (tmp_path / "mine.yaml").write_text(
        "{name: Mine, sources: {}, firings_per_turn: 90, beams: {elevation_deg: [0]}}"
    )
    mine = Scenario.from_data({"scene": "seed", "sensor": {"model": "mine.yaml"}}, folder=tmp_path)
    assert prepare(mine).survey.ray_count == 3 * 90


def test_mesh_files_are_placed(scenario, crate):
    loaded = scenario(
        """
        scene:
          files:
            - crate.stl
            - {file: crate.stl, unit: cm, translation: [10, 0, 0], rotation_deg: [90, 0, 0]}
            - file: crate.stl
              up_axis: y
              scale: [1, 1, 2]
            - file: crate.stl
              matrix: [[1, 0, 0, 7], [0, 1, 0, 8], [0, 0, 1, 9], [0, 0, 0, 1]]
          ground: {height_m: -4, margin_m: 1}
        """
    )
    built = prepare(loaded)
    assert built.scene.names == ("crate", "crate.2", "crate.3", "crate.4", "Ground")
    sizes = np.ptp(built.scene.object_bounds, axis=1)
    np.testing.assert_allclose(sizes[:4], [[2, 4, 6], [0.02, 0.06, 0.04], [2, 6, 8], [2, 4, 6]])
    np.testing.assert_allclose(built.scene.object_bounds[3].mean(axis=0), [7, 8, 9])
    np.testing.assert_allclose(built.scene.object_bounds[4], [[-2, -4, -4], [11.01, 11, -4]])
    assert built.job.planning is None


def test_georeferenced_poses_and_plans_are_local(scenario, crate):
    loaded = scenario(
        """
        scene: {files: [{file: crate.stl, translation: [500000.5, 4000000.25, 100]}]}
        poses: [[500010.5, 4000000.25, 101], {position: [500000, 4000010, 102], yaw_deg: 45}]
        planning: {start: [500010, 4000000], target: [499990, 4000000], clearance_m: 0.5}
        """
    )
    scene, survey, planning = everything(loaded)
    world = [np.add(pose.position, scene.origin).tolist() for pose in survey.poses]
    assert world == [[500010.5, 4000000.25, 101], [500000, 4000010, 102]]
    assert np.abs([pose.position for pose in survey.poses]).max() < 20
    assert survey.poses[1].yaw_deg == 45
    np.testing.assert_allclose(planning.centers + scene.origin[:2], [[500000.5, 4000000.25]])
    np.testing.assert_allclose(planning.radii, np.hypot(1, 2) + 0.5)
    assert np.add(planning.start, scene.origin[:2]).tolist() == [500010, 4000000]


def test_obstacles(scenario):
    def plan(text):
        ground = "scene: {preset: seed, ground: {margin_m: 20}}"  # flat, so it is no obstacle
        ends = "start: [25, 25], target: [-30, -20]"
        return everything(scenario(f"{ground}\nplanning: {{{ends}, {text}}}"))[2]

    assert len(plan("obstacles: auto").radii) == 6
    assert len(plan("obstacles: []").radii) == 0
    assert len(plan('obstacles: ["*e*", {object: Vase}]').radii) == 4  # Vase once
    disc = plan("obstacles: [{center: [1, 2], radius_m: 3}], clearance_m: 0.5")
    assert (disc.centers.tolist(), disc.radii.tolist()) == ([[1, 2]], [3.5])
    assert plan("enabled: false") is None


def test_numbers_as_everybody_writes_them(scenario):
    loaded = scenario("cloud: {precision_m: 1e-3}\nsensor: {max_range_m: .inf, step_deg: 20}")
    assert (loaded.cloud.precision_m, loaded.sensor.step_deg) == (0.001, 20)


def test_short_forms_say_the_same(scenario):
    short = (
        "scene: seed\nsensors: {a: vlp16, b: {model: ouster/os1-64, mount: [0, 0, 1]}}\n"
        "navigation: {imu: {mount: [1, 0, 0]}}\nposes: [[0, 0, 1]]\n"
    )
    long = (
        "scene: seed\nsensors: {a: {model: velodyne/vlp16}, b: {model: ouster/os1-64, "
        "mount: {position: [0, 0, 1]}}}\nnavigation: {imu: {mount: {position: [1, 0, 0]}}}\n"
        "poses: [[0, 0, 1]]\n"
    )
    one, other = (fingerprint(prepare(scenario(text)).survey) for text in (short, long))
    assert one == other
    short = "scene: seed\nsensor: vlp16\nmount: [0, 0, 2]"
    long = "scene: seed\nsensor: {model: velodyne/vlp16}\nmount: {position: [0, 0, 2]}"
    one, other = (fingerprint(prepare(scenario(text)).survey) for text in (short, long))
    assert one == other


def test_a_model_of_ones_own_is_a_file_beside_the_scenario(scenario, tmp_path):
    data = files("lidarsim.sensor") / "data" / "velodyne" / "vlp16.yaml"
    (tmp_path / "mine.yaml").write_text(data.read_text().replace("VLP-16", "Mine"))
    made = scenario("scene: seed\nsensor: mine.yaml")
    assert made.files == (tmp_path / "mine.yaml",)
    assert prepare(made).survey.mounted_sensors[0].sensor.name == "Velodyne Mine"


def test_actors_that_stand(scenario):
    text = "scene: seed\nactors:\n  - {name: A, box: [2, 1, 1], at: [9, 8, 1]}\n"
    text += "  - {name: B, box: [2, 1, 1], at: {position: [9, 8, 1], yaw_deg: 90}}\n"
    straight, turned = prepare(scenario(text)).scene.actors
    for time in (0, 1e9, 1e12):
        low, high = (corner(straight.mesh_at(time).vertices, 0) for corner in (np.min, np.max))
        np.testing.assert_allclose([low, high], [[8, 7.5, 1], [10, 8.5, 2]], atol=1e-12)
    low, high = (corner(turned.mesh_at(5e9).vertices, 0) for corner in (np.min, np.max))
    np.testing.assert_allclose([low, high], [[8.5, 7, 1], [9.5, 9, 2]], atol=1e-12)


IDENTITY = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"
BAD = [
    (
        "sensor: {layers: 4}\nsensors: {a: {}}",
        "`sensors` cannot be combined with `sensor` or `mount`",
    ),
    ("output: {write: [laz, mcap, {format: mcap, layout: ouster}]}", "`write` contains mcap twice"),
    # (text, what the message says after the file's name)
    ("sensor: {layers: 0}", r"sensor\.layers must be from 1 to 65535, but is 0"),
    ("sensor: {layers: '40'}", r"sensor\.layers must be a whole number, but is '40'"),
    ("sensors: {a: {mount: {positon: [0, 0, 0]}}}", "a.mount.positon'.* mean 'position'"),
    (
        "scene: {files: [{file: a.ply, position: [0, 0, 1]}]}",
        r"Unknown field 'scene.files\[0\]\.position'\. Did you mean 'translation'\?",
    ),
    ("sensr: {}", r"Unknown field 'sensr'\. Did you mean 'sensor'\?"),
    (
        "performance: ideal",
        r"Unknown field 'performance'. It is a field of sensor\. Move it there\.$",
    ),
    ("performance: datasheet", r"Write sensor: {model: …, performance: datasheet}\.$"),
    ("sensor: vlp16\nperformance: ideal", r"Write sensor: {model: …, performance: ideal}\.$"),
    ("sensors: {a: vlp16}\nrate_hz: 5", r"Write sensors: {roof: {model: …, rate_hz: 5}}\.$"),
    (
        "output: {write: ply, format: kiti}",
        r"must be a list, but is 'ply'\. Write \[ply\]\.\n.*Unknown field 'output\.format'\. "
        r"Write output: {write: "
        r"\[kitti\]}\.$",
    ),
    (
        "cloud: {formats: [laz]}",
        r"Unknown field 'cloud\.formats'\. Write output: {write: \[laz\]}\.$",
    ),
    ("formats: las", r"Unknown field 'formats'\. Write output: {write: \[las\]}\.$"),
    ("output: {formats: [laz]}", r"Unknown field 'output\.formats'\. Did you mean 'write'\?$"),
    ("layout: ouster", r"Write output: {write: \[{format: …, layout: ouster}\]}\.$"),
    (
        "sensor: {model: vlp16, mount: [0, 0, 1]}",
        r"Move it next to 'sensor'\. Or write sensors: {roof: {model: …, mount: …}}\.$",
    ),
    ("sensors: {model: vlp16, mount: [0, 0, 1]}", r"a name: sensors: {roof: {model: …, mount: …}}"),
    (
        "sensor: {steps: 4}",
        r"mean 'step_deg'\? 'steps' is also a top-level field, next to 'sensor'\.$",
    ),
    ("reflectance: 0.3", r"Write materials: \[{objects: …, reflectance: 0\.3}\]\.$"),
    ("scene: {class: 4}", r"Write scene: {copies: \[{name: …, box: …, at: …, class: 4}\]}\.$"),
    # other units
    (
        "weather: {visibility_m: 60}",
        r"Unknown field 'weather.visibility_m'\. Write visibility_km: 0\.06\.$",
    ),
    ("weather: {visibilty_m: '60'}", r"mean 'visibility_km'\? Its unit is km, not m\.$"),
    (
        "visibility_m: 60",
        r"Unknown field 'visibility_m'\. Write weather: {visibility_km: 0\.06}\.$",
    ),
    ("sensor: {model: vlp16, rate_rpm: 600}", r"Write rate_hz: 10\.$"),
    ("noise: {range_mm: 20}", r"Write range_m: 0\.02\.$"),
    ("returns: {divergence_deg: [0.18, 0.09]}", r"mrad: \[3\.14159265359, 1\.57079632679\]\.$"),
    ("poses: [{position: [0, 0, 1], yaw_rad: 1}]", r"Write yaw_deg: 57\.2957795131\.$"),
    ("cloud: {precision_meters: 0.01}", r"Did you mean 'precision_m'\?$"),
    ("weather: {rain_in_h: 1}", r"Write rain_mm_h: 25\.4\.$"),
    ("weather: {dust_g_m3: 0.1}", r"Write dust_mg_m3: 100\.$"),
    ("points: [[0, 0, 1]]", r"Unknown field 'points'\.$"),
    ("sensor: {rain_mm_h: 9}", r"'sensor\.rain_mm_h'. It is a field of weather. Move"),
    ("columns: [range]", "It is a field of cloud. Move it there"),
    ("unit: mm", r"Or write scene: {files: \[{file: …, unit: mm}\]}\.$"),
    ("trajectory: {start: 3}", "mean 'start_s'[?] 'start' is a field of cloud"),
    ("sensor: {vertical_fov_deg: .nan}", r"must be a finite number, but is nan"),
    ("sensor: {model: velodyne/vlp61}", "Unknown sensor model .* Did you mean 'velodyne/vlp16'"),
    ("sensor: vlp61", "Unknown sensor model .* Did you mean 'vlp16'"),
    (
        "mount: roof",
        r"mount must be x, y and z in meters, such as \[0, 0, 1\], or .*, but is 'roof'",
    ),
    (
        "actors: [{name: A, box: [1, 1, 1], at: [1, 2]}]",
        r"actors\[0\]\.at\.position\[2\] is required",
    ),
    (
        "actors: [{name: A, box: [1, 1, 1], at: [1, 2, 0], trajectory: a.csv}]",
        "`trajectory` and `at` cannot be combined",
    ),
    ("sensor: {model: ouster/os1-64, layers: 64}", "`model` and `layers` cannot be combined"),
    ("sensor: [1]", r"sensor must be a mapping, but is \[1\]"),
    ("poses: [0, 0, 1]", r"poses\[0\] must be x, y and z in meters.*, but is 0"),
    ("poses: [{position: [0, 0, 0], yaw: 5}]", r"'poses\[0\]\.yaw'.*'yaw_deg'"),
    ("poses: &a [*a]", r"s\.yaml, line 1: 'a' contains itself"),
    ("scene: {files: [{file: a.stl, unit: parsec}]}", r"unit must be 'um', .*, but is 'parsec'"),
    ("scene: {files: [{file: a.stl, scale: 0}]}", "`scale` must not be 0"),
    (
        "scene: {files: [{file: a.stl, scale: 2, matrix: " + IDENTITY + "}]}",
        "`matrix` and `scale` cannot be combined",
    ),
    ("scene: {files: [{file: a.stl, matrix: " + IDENTITY.replace("1", "0") + "}]}", "0 0 0 1"),
    ("scene: {preset: sead}", r"preset cannot be 'sead'\. Did you mean 'seed'\? It must be 'seed'"),
    (
        "scene: seed\nplanning: {start: [5, 5], target: [9, 9]}",
        r"`planning\.start` must be outside all obstacles, .* center of Bowl",
    ),
    (
        "scene: seed\nplanning: {start: [25, 25], target: [-30, -20], obstacles: [Bel]}",
        "Did you mean 'Bell'",
    ),
    ("scene: seed\nplanning: {trials: 5}", r"`planning` requires a start and a target"),
    ("scene: seed\nplanning: {start: [5, 5]}", r"Set `planning\.start` and `planning\.target`\."),
    ("scene: {preset: none}", r"preset must be 'seed', but is 'none'"),
    ("planning: {obstacles: [{center: [0, 0]}]}", "both `center` and `radius_m`"),
    ("scene: a.stl\nplanning: {enabled: true}", r"Set `planning\.start` and `planning\.target`"),
    ("pool: {backend: opengl}", "must be 'auto', 'cuda', 'tiles' or 'numpy'"),
    ("", "is empty. A scenario is a mapping with sections"),
    ("hello", "contains only 'hello'"),
    ("a: b: c", "line 1: mapping values are not allowed here"),
    ("steps: 4\nsensor: {}\nsteps: 5", "line 3: the key 'steps' is duplicated"),
    ("[" * 50_000, "not valid YAML: maximum recursion depth"),
    ("steps: !!python/object/apply:os.getcwd []", "line 1: could not determine a constructor"),
    ("sensor: {layers: " + "9" * 5000 + "}", r"sensor\.layers is 9+\.\.\.|Exceeds the limit"),
    (b"\xff\xfe\x00", "not valid YAML: 'utf-8' codec"),
    ('sensor: {model: "~nosuchuser/x.yaml"}', r"~nosuchuser/x\.yaml"),
    ('scene: {files: ["~nosuchuser/x.stl"]}', r"~nosuchuser/x\.stl.* does not exist"),
]


@pytest.mark.parametrize(("text", "message"), BAD, ids=[str(i) for i in range(len(BAD))])
def test_bad_scenarios(scenario, tmp_path, text, message):
    with pytest.raises(LidarError, match=message) as caught:
        everything(scenario(text))
    for line in str(caught.value).splitlines():
        assert str(tmp_path) in line
        assert len(line) < 300 + len(str(tmp_path))


def test_a_long_list_of_names_follows_the_hint_in_lines_of_its_own(scenario):
    with pytest.raises(LidarError) as raised:
        scenario("cloud: {columns: [rnage, x_m]}")
    first, *names = str(raised.value).splitlines()
    assert first.endswith("columns[0] cannot be 'rnage'. Did you mean 'range'? It must be")
    assert names[0].startswith("  'ray', 'time', 'azimuth', ") and len(names) > 3
    assert max(map(len, names)) <= 100
    ending = " ".join(name.strip() for name in names[-2:])
    assert ending.endswith("'normal_z'. The same applies to 1 other entry: 'x_m'.")


@pytest.mark.extended
def test_all_faults_are_told_at_once(scenario, tmp_path):
    of_fields = "steps: 0\nsensor: {layers: 0, layer: 1}\ncloud: {keep_every: 0}\n"
    of_sections = (
        "scene: no.glb\nplanning: {start: [0, 0], enabled: true}\nposes: [[0, 0, 1]]\n"
        "trajectory: drive.tum\nreturns: {subrays: 7}\n"
    )
    did_you_mean = "Unknown field 'sensor.layer'. Did you mean 'layers'?"
    for text, words in (
        (
            of_fields,
            [
                "sensor.layers must be from 1 to 65535, but is 0",
                did_you_mean,
                "steps must be from 1 to 10000000, but is 0",
                "cloud.keep_every must be from 1 to 1000000, but is 0",
            ],
        ),
        (
            of_sections,
            ["`planning` requires a start", "`poses` and `trajectory` cannot", "beam divergence"],
        ),
    ):
        with pytest.raises(LidarError) as raised:
            scenario(text)
        lines = str(raised.value).splitlines()
        assert len(lines) == len(words)
        for line, word in zip(lines, words, strict=True):
            assert word in line and str(tmp_path) in line
    with pytest.raises(LidarError) as raised:
        scenario("poses: [" + 100 * "[0, 0], " + "]")
    assert str(raised.value).endswith(
        "poses[0].position[2] is required. The same applies to 99 other entries."
    )
    with pytest.raises(LidarError) as raised:
        scenario("\n".join(f"field{number}: 1" for number in range(100)))
    assert str(raised.value).splitlines()[-1] == "And 80 more."


def test_all_files_that_cannot_be_read_are_told_at_once(scenario):
    with pytest.raises(LidarError) as raised:
        prepare(scenario("scene: [no.glb, nor.stl]"))
    assert str(raised.value).count("does not exist") == 2


@pytest.mark.parametrize(
    ("text", "field", "file"),
    [
        ("scene: no.glb", "scene.files[0].file", "no.glb"),
        (
            "scene: seed\nactors: [{name: A, file: no.urdf, at: [1, 1, 0]}]",
            "actors[0].file",
            "no.urdf",
        ),
        (
            "scene: {preset: seed, copies: [{name: T, box: [1, 1, 1], table: no.csv}]}",
            "scene.copies[0].table.file",
            "no.csv",
        ),
        ("scene: seed\ntrajectory: no.tum", "trajectory.file", "no.tum"),
        (
            "scene: seed\ntraffic: {file: no.xml, vehicles: [{box: [1, 1, 1]}]}",
            "traffic.file",
            "no.xml",
        ),
        ("scene: seed\nsensor: {calibration: no.json}", "sensor.calibration", "no.json"),
        ("sensors: {roof: unit-17.yaml}", "sensors.roof.model", "unit-17.yaml"),
    ],
)
def test_a_file_that_is_lost_is_told_with_scenario_and_field(scenario, tmp_path, text, field, file):
    with pytest.raises(LidarError) as raised:
        prepare(scenario(text))
    (line,) = str(raised.value).splitlines()
    assert line.endswith(f"s.yaml: {field}: {tmp_path / file} does not exist.")


def test_a_file_that_is_lost_is_told_beside_other_faults_and_a_similar_name(scenario, tmp_path):
    (tmp_path / "hall.glb").write_bytes(b"")
    with pytest.raises(LidarError) as raised:
        prepare(scenario("scene: [hal.glb, hall.glb]"))
    lost, empty = str(raised.value).splitlines()
    assert "scene.files[0].file: " in lost and lost.endswith(" Did you mean 'hall.glb'?")
    assert "hall.glb is empty" in empty
    with pytest.raises(LidarError) as raised:
        prepare(Scenario.load(tmp_path / "no.obj"))
    assert str(raised.value).startswith(f"{tmp_path / 'no.obj'} does not exist.")


def test_formats_that_contradict_the_frame_of_points_are_in_the_advice(scenario):
    read = scenario(
        "scene: seed\ncloud: {coordinates: sensor}\noutput: {write: [mcap, laz, kitti]}"
    )
    las, kitti = (note for note in advice(prepare(read)) if "class" not in note)
    assert (
        "expect all points in a single coordinate system" in las
        and "Set `cloud.coordinates: world`" in las
    )
    assert "KITTI stores motion-compensated points" in kitti
    assert advice(prepare(scenario("scene: seed\noutput: {write: [laz, pcd]}"))) == []


@pytest.mark.parametrize(
    ("seconds", "start", "noted"),
    [
        (1777890600.25, "", "set `cloud: {start: 2026-05-04T10:30:00.250000+00:00}`"),
        (1777890600.25, 'cloud: {start: "2026-05-04T10:30:00Z"}', ""),
        (1e8, "", ""),  # of a clock since some start
    ],
)
def test_a_trajectory_since_1970_is_told_that_its_date_is_not_kept(scenario, seconds, start, noted):
    points = [{"time_s": seconds + t, "position": [t, 0, 1]} for t in (0, 1)]
    read = scenario(
        f"scene: seed\ntrajectory: {json.dumps({'points': points})}\nsteps: 36\n{start}"
    )
    notes = [note for note in advice(prepare(read)) if "since 1970" in note]
    assert len(notes) == bool(noted)
    assert all(noted in note for note in notes)


def test_what_is_assumed_of_trajectories_without_angles_is_in_the_advice(scenario):
    legs = [{"time_s": t, "position": [x, y, 1]} for t, x, y in ((0, 0, 0), (2, 9, 0), (4, 9, 9))]
    turned = [point | {"yaw_deg": 0} for point in legs]
    vans = [
        {"name": name, "box": [4, 2, 2], "trajectory": {"points": points} | options}
        for name, points, options in (
            ("Van", legs[:2], {}),
            ("Bus", legs, {"interpolation": "smooth"}),
            ("Cab", turned, {}),
        )
    ]
    faces = "so its poses are level and face the direction of travel"
    turns = (
        ". At a corner between straight lines, the poses turn from 1 m before to 1 m after the "
        "corner. For a path without corners, set `interpolation: smooth`"
    )
    for points, actors, notes in (
        (legs, [], [f"the trajectory of the platform has no angles, {faces}{turns}"]),
        (legs[:2], [], [f"the trajectory of the platform has no angles, {faces}"]),
        (turned, [], []),
        (turned, vans, ["the trajectories of Van, Bus have no angles, so their poses are level "
                        "and face the direction of travel"]),
    ):  # fmt: skip
        data = {"trajectory": {"points": points}, "actors": actors, "steps": 36}
        read = scenario(json.dumps({"scene": {"preset": "seed"}} | data))
        assert [note for note in advice(prepare(read)) if "angles" in note] == notes


def test_sensors_that_have_another_name_in_a_format_are_in_the_advice(scenario):
    sensors = "scene: seed\nsensors: {roof: {}, rear: {mount: [-1, 0, 0]}}\n"
    (note,) = advice(prepare(scenario(sensors + "output: {write: [nuscenes, pcd]}")))
    assert note.startswith("nuScenes expects the first sensor to be named 'LIDAR_TOP'")
    assert advice(prepare(scenario("scene: seed\noutput: {write: [nuscenes]}"))) == []


@pytest.mark.parametrize(
    ("weather", "noise", "noted"),
    [
        ("visibility_km: 0.06", "", "causes no returns, because `noise.detection_range_m` is"),
        ("visibility_km: 0.06", "detection_range_m: 90", None),
        (
            "visibility_km: 0.06, fog_lidar_ratio_sr: null",
            "detection_range_m: 90",
            "causes no returns, because `weather.fog_lidar_ratio_sr` is null",
        ),
        ("visibility_km: 23", "", None),  # the returns of haze are too faint to be detected
        ("", "", None),
    ],
)
def test_fog_that_returns_no_light_is_in_the_advice(scenario, weather, noise, noted):
    built = prepare(scenario(f"scene: seed\nweather: {{{weather}}}\nnoise: {{{noise}}}"))
    notes = [note for note in advice(built) if "fog" in note]
    assert len(notes) == (noted is not None)
    assert all(noted in note for note in notes)


@pytest.mark.parametrize(
    ("text", "noted"),
    [
        ("returns: {mode: dual}", "is dual, .* Set `returns: {subrays: 7, divergence_mrad: 3}`$"),
        ("sensor: vlp16\nreturns: {mode: two_strongest}", "two_strongest, .* {subrays: 7}`$"),
        ("sensor: own.yaml", "is dual, .* single ray .*{subrays: 7, divergence_mrad: 3}`$"),
        ("sensors: {a: own.yaml, b: {model: vlp16}}", "returns mode of a is dual"),
        ("sensor: own.yaml\nreturns: {subrays: 7, divergence_mrad: 3}", None),
        ("sensor: vlp16\nreturns: {mode: dual, subrays: 7}", None),
        ("returns: {mode: last}", None),
        (
            "returns: {mode: dual}\nmaterials: [{objects: '*', specular_reflectance: 0.1}]",
            None,
        ),
        ("returns: {mode: dual}\nmaterials: [{objects: '*', transparent: pass}]", None),
        (
            "returns: {mode: dual, divergence_mrad: 3}\nweather: {rain_mm_h: 1}\n"
            "noise: {detection_range_m: 90}",
            None,
        ),
    ],
)
def test_returns_that_no_pulse_has_are_in_the_advice(scenario, tmp_path, text, noted):
    (tmp_path / "own.yaml").write_text(
        "name: Own\nsources: {angles: a data sheet, times: even}\nfirings_per_turn: 360\n"
        "rate_hz: 10\nrange_m: [0.5, 100]\nbeams: {elevation_deg: {first: 0, last: 9, count: 4}}\n"
        "performance: {mode: dual}\n"
    )
    notes = [
        note for note in advice(prepare(scenario(f"scene: seed\n{text}"))) if "returns mode" in note
    ]
    assert len(notes) == (noted is not None)
    assert all(re.search(noted, note) for note in notes)


@pytest.mark.extended
@pytest.mark.parametrize(
    ("idle", "used"),
    [
        ("cloud: {waveform_samples: 40}", "output: {write: [laz]}"),
        (
            "weather: {fog_lidar_ratio_sr: 18.8}",
            "weather: {fog_lidar_ratio_sr: 9, visibility_km: 1}\nnoise: {detection_range_m: 6}",
        ),
        (
            "noise: {detection_range_m: 6, stray_light: 1}",
            "materials: [{objects: '*', retro: true}]",
        ),
        ("noise: {velocity_m_s: 0.1}", "cloud: {columns: [radial_velocity]}"),
    ],
)
def test_settings_without_effect_are_in_the_advice(scenario, idle, used):
    read = scenario(f"scene: seed\n{idle}")
    (note,) = advice(prepare(read))
    assert idle.split("{")[1].split(": ")[-2].split(", ")[-1] in note
    both = scenario("scene: seed\n" + (used if used[:5] == idle[:5] else f"{idle}\n{used}"))
    assert advice(prepare(both)) == []


YAML_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(["file", "files", "position", "layers", "seed", "object", "x"]),
            inner,
            max_size=4,
        )
    ),
    max_leaves=12,
)


@pytest.mark.extended
@settings(max_examples=100)
@given(
    st.dictionaries(
        st.sampled_from(["scene", "sensor", "poses", "steps", "cloud", "planning", "pool", "x"]),
        YAML_VALUES,
        max_size=4,
    )
)
def test_any_data_is_a_scenario_or_one_error_for_users(data):
    try:
        loaded = Scenario.from_data(data, source="s.yaml")
    except LidarError as error:
        assert all(re.match(r"s.yaml: |And \d+ more", line) for line in str(error).splitlines())
    else:
        assert set(data) <= set(Scenario.model_fields)
        assert (loaded.steps or 1) >= 1


def test_materials_returns_noise_and_weather_become_those_of_the_survey():
    points = [{"time_s": 0, "position": [0, 0, 0]}, {"time_s": 9, "position": [1, 0, 0]}]
    scenario = Scenario.from_data(
        {
            "scene": "seed",
            "sensor": {"model": "ouster/os1-64"},
            "materials": [
                {"objects": ["V*", "Bowl"], "transparent": "pass"},
                {"objects": "*", "reflectance": 0.3, "class": 7},
            ],
            "actors": [
                {"name": "Van", "box": [4, 2, 2], "class": 9, "trajectory": {"points": points}}
            ],
            "returns": {"mode": "dual", "subrays": 7},
            "noise": {"range_m": 0.02, "seed": 3},
            "weather": {"visibility_km": 2},
        }
    )
    survey = prepare(scenario).survey
    assert survey.returns == Returns("dual", 7)
    assert survey.noise == Noise(0.02, seed=3)
    assert survey.visibility_km == 2
    assert survey.precision_m == 0.001, "the sensor's"
    table = MaterialTable.build(
        survey.materials, SurfaceKinds.from_objects(["Sphere", "Vase", "Bowl", "Van"])
    )
    assert table.semantic_class.tolist() == [7, 0, 0, 9], "an actor's own class"
    assert table.reflectance.tolist() == [0.3, 0, 0, 0], "with the rest of its material"
    assert table.passes.tolist() == [False, True, True, True]


def mesh_file(path, size, height, **asset):
    """A glTF of trimesh's with a box, as if something else had written it; or an .stl."""
    box = trimesh.creation.box(size)
    box.apply_translation([0, 0, height])
    if path.suffix == ".glb":
        path.write_bytes(
            export_glb(trimesh.Scene(box), tree_postprocessor=lambda tree: tree.update(asset=asset))
        )
    else:
        box.export(path)
    return path


@pytest.mark.extended
@pytest.mark.parametrize(
    ("height", "expected"), [(2.4, [0.6, 1.2, 1.8]), (3.1, [0.775, 1.55, 2.325]), (6, [1, 2, 3])]
)
def test_a_mesh_alone_is_scanned_below_its_ceiling_and_whole(tmp_path, height, expected):
    made = Scenario.load(mesh_file(tmp_path / "hall.stl", (8, 6, height), height / 2))
    survey = prepare(made).survey
    assert [pose.position[2] for pose in survey.poses] == pytest.approx(expected)
    assert (survey.keep_every, survey.precision_m) == (1, 0.001)
    listed = Scenario.from_data({"scene": "hall.stl"}, folder=tmp_path)
    assert fingerprint(prepare(listed).survey) == fingerprint(survey)
    coarse = Scenario.from_data(
        {"scene": "hall.stl", "sensor": {"model": "velodyne/vlp16"}}, folder=tmp_path
    )
    assert prepare(coarse).survey.precision_m == 0.002, "the sensor's resolution"


@pytest.mark.parametrize(
    ("size", "generator", "entry", "says"),
    [
        ((8, 3, 6), "Blender", "hall.glb", "rotated from Y-up to Z-up, as glTF requires"),
        ((8, 6, 2), "Blender", "hall.glb", "is now 8 m wide, 6 m high and 2 m thick"),
        ((8, 3, 6), "https://github.com/mikedh/trimesh", "hall.glb", "written by trimesh"),
        ((8, 6, 2), "lidarpool", "hall.glb", ""),
        ((8, 6, 2), "trimesh", {"file": "hall.glb", "up_axis": "y"}, ""),
        ((8, 6, 2), "trimesh", {"file": "hall.glb", "up_axis": "z"}, ""),
    ],
)
def test_it_is_told_that_gltf_was_turned_and_what_to_say(tmp_path, size, generator, entry, says):
    width = size[0]
    height = size[1]
    depth = size[2]
    mesh_file(tmp_path / "hall.glb", (width, height, depth), 0, generator=generator, version="2.0")
    made = Scenario.from_data({"scene": {"files": [entry]}}, folder=tmp_path)
    told = [note for note in advice(prepare(made)) if "up_axis" in note]
    assert len(told) == bool(says)
    if says:
        assert says in told[0] and "set {file: …, up_axis: z}. To silence" in told[0]


def test_notes_say_settings_as_in_a_scenario_or_as_in_python(tmp_path, caplog):
    mesh_file(tmp_path / "hall.glb", (8, 6, 2), 0, generator="Blender", version="2.0")
    made = Scenario.from_data({"scene": {"files": ["hall.glb"]}}, folder=tmp_path)
    assert any("set {file: …, up_axis: z}. To silence" in note for note in advice(prepare(made)))
    assert not caplog.messages
    Scene.load(tmp_path / "hall.glb")
    assert 'Scene.load(path, up_axis="z"). To silence' in caplog.messages[0]


def test_a_start_is_a_time_of_yaml_or_text(scenario):
    for text in ("2026-11-21T10:00:00Z", "'2026-11-21T12:00:00+02:00'"):
        survey = prepare(
            scenario(f"scene: seed\nworld: {{epsg: 25832}}\ncloud: {{start: {text}}}")
        ).survey
        assert (survey.epsg, survey.start) == (25832, datetime(2026, 11, 21, 10, tzinfo=UTC))
    with pytest.raises(LidarError, match=r"cloud\.start"):
        scenario("cloud: {start: 2026-11-21T10:00:00}")


@pytest.mark.extended
@pytest.mark.skipif(find_spec("rasterio") is None, reason="rasterio is an extra")
@pytest.mark.parametrize(
    ("epsg", "place", "words"),
    [
        (32632, [0, 0, 0], ""),
        (2056, [2_600_000, 1_200_000, 400], ""),
        (7415, [84_600, 447_000, 0], ""),
        (3857, [0, 0, 0], r"Pseudo-Mercator\), a world map projection"),
        (3395, [1_000_000, 6_000_000, 0], "a world map projection"),
        (2056, [0, 0, 0], r"The scene is at x 0, y 0, outside the area of use of EPSG:2056"),
        (5070, [1_627_222, 355_426, 0], r"0\.988 to 1\.01 m long.*Use EPSG:32617, which is true"),
        (2263, [0, 0, 0], "which is not in meters"),
        (4326, [8, 47, 0], "which is not in meters"),
    ],
)
def test_the_coordinate_system_has_true_meters(tmp_path, epsg, place, words):
    mesh_file(tmp_path / "hall.stl", (8, 6, 2), 2)
    entries = [{"file": "hall.stl", "up_axis": "z", "translation": place}]
    data = {"scene": {"files": entries}, "world": {"epsg": epsg}}
    scenario = Scenario.from_data(data, folder=tmp_path)
    if not words:
        assert prepare(scenario).survey.epsg == epsg
        return
    with pytest.raises(LidarError, match=rf"EPSG:{epsg}") as refused:
        prepare(scenario)
    assert re.search(words, str(refused.value))
    if epsg == 2056:
        with pytest.raises(LidarError, match="EPSG:2056"):
            Job(Scene.seed(), Survey(poses=[(0, 0, 1)], epsg=epsg))


WAY = "[" + ", ".join(f"{{time_s: {t}, position: [0, {t}, {t * t}]}}" for t in range(3)) + "]"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("cloud: {columns: [red]}", "uses colors"),
        (
            f"navigation: {{imu: {{}}}}\ntrajectory: {{interpolation: linear, points: {WAY}}}",
            "interpolation: smooth",
        ),
    ],
)
def test_what_would_disappoint_is_in_the_advice(scenario, text, words):
    assert words in " ".join(advice(prepare(scenario(f"scene: seed\n{text}"))))
    calm = text.replace("red", "range").replace("linear", "smooth")
    assert words not in " ".join(advice(prepare(scenario(f"scene: seed\n{calm}"))))


def test_an_object_far_from_all_others_is_named_where_points_would_be_too_coarse():
    meshes = [box(name, (1, 1, 1)) for name in ("one", "two", "three")]
    fallen = SceneInstance(box("fallen", (1, 1, 1)), Pose((0, 0, -7e7)))
    survey = Survey(poses=[(0, 0, 1)], precision_m=0.001)
    message = "Set it to at least 0.018, or remove 'fallen', which is far from all other objects."
    with pytest.raises(LidarError, match=re.escape(message)):
        Job(Scene.from_meshes([*meshes, fallen]), survey)
    with pytest.raises(LidarError, match=r"Set it to at least 0.018\.$"):
        Job(Scene.from_meshes([fallen, meshes[0]]), survey)


def test_an_obstacle_whose_name_has_brackets(tmp_path, scenario):
    walls = "v 0 0 0\nv 1 0 0\nv 0 1 2\no Wall[1]\nf 1 2 3\no Wall1\nf 1 2 3\n"
    (tmp_path / "m.obj").write_text(walls)
    ends = "scene: m.obj\nplanning: {start: [-9, 0], target: [9, 0], obstacles: "
    for names, count in (('["Wall[1]"]', 1), ('["Wall[12]"]', 1), ('["Wall*"]', 2)):  # 1 or 2
        assert len(prepare(scenario(ends + names + "}")).job.planning.radii) == count
