"""Effects files: what they contain, what is refused with which reason, and inserted meshes."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from lidarfiles.identity.fingerprint import fingerprint
from lidarreal.augmentation.effects import Effects, Insertion
from lidarreal.augmentation.insertions import load_insertion
from lidarscenario.scenario import Scenario
from lidarsim import LidarError
from lidarsim.media.materials import MaterialTable
from lidarsim.media.weather import Weather
from lidarsim.pulses.steps.step import Role
from lidarsim.pulses.steps.step_list import STEPS
from lidarsim.simulator.recorded_sweeps import scene_of_bodies
from lidarsim.survey.faults import Fault

EXAMPLES = Path(__file__).parents[3] / "examples"
TRACK = "{points: [{time_s: 0, position: [0, 0, 0]}, {time_s: 1, position: [9, 0, 0]}]}"
VAN = f"actors: [{{name: van, box: [5, 2, 2], class: 3, trajectory: {TRACK}}}]"


@pytest.fixture
def effects(tmp_path):
    """Return a function that loads effects from the text of a file, and from options."""

    def load(text, **options):
        path = tmp_path / "effects.yaml"
        path.write_text(text)
        return Effects.load(path, options)

    return load


def test_sections_that_change_pulses_are_read(effects):
    read = effects(
        "weather: {rain_mm_h: 5, visibility_km: 2}\n"
        "noise: {range_m: 0.02, dropout: 0.1, seed: 7}\n"
        "faults: [{kind: dirt, transmission: 0.5}]\n"
        "returns: {mode: dual}\n"
        "materials: [{objects: car, reflectance: 0.3}]\n"
        "classes: {10: car}\n"
    )
    assert read.weather == Weather(rain_mm_h=5, visibility_km=2)
    assert read.noise == {"range_m": 0.02, "dropout": 0.1}
    assert read.faults == (Fault("dirt", transmission=0.5),)
    assert read.mode == "dual"
    assert read.seed == 7
    assert read.classes == {10: "car"}
    assert [material.objects for material in read.materials] == [("car",)]
    assert not read.is_empty


def test_options_override_the_file(effects):
    read = effects(
        "weather: {rain_mm_h: 5, dust_mg_m3: 3}\n"
        "faults: [{kind: dirt, transmission: 0.5}, {kind: dead_channels, channels: [1]}]\n",
        weather={"rain_mm_h": 20},
        faults=[{"kind": "dirt", "transmission": 0.1}],
    )
    assert read.weather == Weather(rain_mm_h=20, dust_mg_m3=3)
    assert [fault.kind for fault in read.faults] == ["dead_channels", "dirt"]
    assert read.faults[1].transmission == 0.1


def test_options_are_enough():
    assert Effects.load(options={"weather": {"snow_mm_h": 2}}).weather.snow_mm_h == 2
    assert Effects.load().is_empty


def test_effects_are_sent_to_other_processes(effects):
    read = effects(f"weather: {{rain_mm_h: 5}}\n{VAN}")
    assert fingerprint(pickle.loads(pickle.dumps(read))) == fingerprint(read)
    assert fingerprint(effects(VAN)) != fingerprint(read)


def test_actors_have_poses_and_classes_in_the_world_of_the_recording(effects):
    read = effects(f"{VAN}\nclasses: {{3: van}}")
    (van,) = read.actors
    positions, _ = van.trajectory.poses(0, np.array([0.5e9]))
    assert positions.tolist() == [[4.5, 0, 0]]
    kinds = scene_of_bodies(actors=read.actors).surface_kinds
    table = MaterialTable.build(read.materials, kinds)
    assert 3 in table.semantic_class
    assert read.classes == {3: "van"}


def test_actors_come_from_files(effects):
    read = effects(
        f"actors: [{{name: walker, file: {EXAMPLES / 'pedestrian.glb'}, at: [5, 0, 0], "
        "animation: Walk}]"
    )
    (walker,) = read.actors
    assert walker.mesh.animation is not None
    assert np.allclose(walker.bounds[:, 2], [0, 1.73], atol=0.02)


def test_robots_are_actors(effects):
    read = effects(f"actors: [{{name: rover, file: {EXAMPLES / 'rover.urdf'}, at: [5, 0, 0]}}]")
    assert len(read.actors) > 1
    assert all(actor.name.startswith("rover/") for actor in read.actors)


def test_traffic_becomes_actors(effects):
    read = effects(
        f"traffic: {{file: {EXAMPLES / 'block-traffic.xml.gz'}, vehicles: [{{box: [4.5, 1.8, 1.5], "
        "class: 10}]}"
    )
    assert len(read.actors) > 5
    assert {material.semantic_class for material in read.materials} == {0, 10}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("scene: seed", ["`scene` cannot be applied", "`actors`", "lidarpool twin"]),
        ("sensor: velodyne/vlp16", ["`sensor` cannot be applied", "`--model`", "`--sensor`"]),
        ("sensors: {a: velodyne/vlp16}", ["`sensors` cannot be applied", "`--model`"]),
        ("poses: [[0, 0, 1]]", ["`poses` cannot be applied", "Remove `poses`"]),
        (f"trajectory: {TRACK}", ["`trajectory` cannot be applied"]),
        ("mount: [0, 0, 2]", ["`mount` cannot be applied"]),
        ("world: {epsg: 25832}", ["`world` cannot be applied"]),
        ("steps: 5", ["`steps` cannot be applied", "`--sweeps`"]),
        ("navigation: {imu: {rate_hz: 100}}", ["`navigation` cannot be applied"]),
        ("cloud: {columns: [range]}", ["`cloud` cannot be applied"]),
        ("output: {write: [las]}", ["`output` cannot be applied", "`--format`"]),
        ("planning: {start: [0, 0], target: [1, 1]}", ["`planning` cannot be applied"]),
        (
            "flight: {density_m2: 5, area: [[[0, 0], [1, 0], [1, 1]]]}",
            ["`flight` cannot be applied", "Remove `flight`"],
        ),
        ("pool: {gpu: 2}", ["`pool` cannot be applied", "`--workers`"]),
        ("returns: {subrays: 7}", ["`returns.subrays` cannot be applied", "lidarpool twin"]),
        ("returns: {divergence_mrad: 3}", ["`returns.divergence_mrad` cannot be applied"]),
        ("returns: {waveform: peaks}", ["`returns.waveform` cannot be applied", "waveforms"]),
        ("noise: {velocity_m_s: 0.1}", ["`noise.velocity_m_s` cannot be applied"]),
        ("noise: {angle_deg: 0.1}", ["`noise.angle_deg` cannot be simulated", "twin"]),
        ("noise: {ripple_deg: 0.1}", ["`noise.ripple_deg` cannot be simulated", "twin"]),
        ("noise: {crosstalk: true}", ["`noise.crosstalk` cannot be simulated", "twin"]),
        ("noise: {stray_light: 1.0e-6}", ["`noise.stray_light` cannot be simulated", "twin"]),
        (
            "faults: [{kind: frozen, from_s: 1}]",
            ["faults[0]: A fault of kind 'frozen' cannot be simulated"],
        ),
        (
            "faults: [{kind: time_jump, by_s: 1}]",
            ["A fault of kind 'time_jump' cannot be simulated"],
        ),
        (
            "faults: [{kind: dirt, transmission: 0.5, sensor: roof}]",
            ["faults[0]: `sensor` cannot be set", "Remove `sensor`"],
        ),
        ("weather: {wet: 0.5}", ["`weather.wet` cannot be simulated", "lidarpool twin"]),
        ("weather: {spray_g_m3: 2}", ["`weather.spray_g_m3` requires wet ground"]),
        ("weather: {spray_g_m3: 2, wet: 1}", ["requires an inserted vehicle that moves"]),
        (
            VAN.replace("{points", "{surfaces: road, points"),
            ["actor 'van': `trajectory.surfaces` cannot be applied", "world frame"],
        ),
        ("actors: [{name: van, box: [5, 2, 2]}]", ["Actor 'van' has no trajectory"]),
        ("actors: [{name: van, file: van.glb, at: [0, 0, 0]}]", ["van.glb does not exist"]),
        ("weather: {rain_mm_h: -1}", ["weather.rain_mm_h"]),
        ("wether: {rain_mm_h: 1}", ["Did you mean 'weather'?"]),
        ("base: other.yaml\nvary: {}", ["is a campaign", "lidarpool augment"]),
        ("", ["is empty", "an effects file"]),
    ],
)
def test_what_cannot_be_applied_is_refused(effects, text, words):
    with pytest.raises(LidarError) as refused:
        effects(text)
    message = str(refused.value)
    assert "effects.yaml" in message
    for word in words:
        assert word.lower() in message.lower()
    assert len(message.splitlines()) == 1


def test_all_mistakes_are_listed(effects):
    with pytest.raises(LidarError) as refused:
        effects("scene: seed\nnoise: {angle_deg: 0.1}\nweather: {wet: 1}")
    assert len(str(refused.value).splitlines()) == 3


def test_default_values_are_accepted(effects):
    """A file with all fields of a scenario at their defaults has no effects."""
    assert effects("noise: {angle_deg: 0.0}\nreturns: {subrays: 1, waveform: none}").is_empty


def test_every_step_has_a_reason_or_acts_on_recordings():
    refused = {step.__name__ for step in STEPS if step.on_recordings}
    assert {"AngleNoiseStep", "RippleStep", "CrosstalkStep", "WaveformStep"} <= refused
    assert all(step.on_recordings for step in STEPS if Role.AIMS in step.role)
    assert all(step.on_recordings.endswith(".") for step in STEPS if step.on_recordings)


@pytest.mark.parametrize(
    ("create", "words"),
    [
        (lambda: Effects(noise={"dropot": 0.1}), "Did you mean 'dropout'?"),
        (lambda: Effects(noise={"seed": 3}), "Set `seed` of the effects instead"),
        (lambda: Effects(noise={"angle_deg": 0.1}), "`noise.angle_deg` cannot be simulated"),
        (lambda: Effects(weather=3), "weather must"),
        (lambda: Effects(weather=Weather(wet=1)), "`weather.wet` cannot be simulated"),
        (lambda: Effects(faults=(Fault("frozen", from_s=1),)), "'frozen' cannot be simulated"),
        (lambda: Effects(mode="best"), "mode must"),
        (lambda: Insertion("car", 1, 2), "mesh must"),
        (lambda: Insertion(load_insertion("car"), "1", 2), "x_m must"),
    ],
)
def test_arguments_are_checked(create, words):
    with pytest.raises(LidarError) as refused:
        create()
    assert words in str(refused.value)


def test_scenarios_become_effects():
    scenario = Scenario.from_data({"weather": {"visibility_km": 1}})
    assert Effects.from_scenario(scenario).weather.visibility_km == 1


@pytest.mark.parametrize(
    ("shape", "size"),
    [
        ("car", (4.6, 1.8, 1.46)),
        ("pedestrian", (0.66, 0.56, 1.75)),
        (EXAMPLES / "car.obj", (4.45, 1.84, 1.47)),
    ],
)
def test_inserted_meshes_stand_on_the_ground(shape, size):
    mesh = load_insertion(shape)
    assert mesh.bounds[0, 2] == 0
    assert np.allclose(np.ptp(mesh.bounds, axis=0), size, atol=0.05)


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ("cat", "There is no object 'cat' to insert. Did you mean 'car'?"),
        ("nowhere.glb", "nowhere.glb does not exist"),
        (Path(__file__), "extension .py"),
    ],
)
def test_what_cannot_be_inserted_is_refused(shape, words):
    with pytest.raises(LidarError, match=words):
        load_insertion(shape)
