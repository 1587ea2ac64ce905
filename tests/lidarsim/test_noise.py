"""Every random number has one use."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import FunctionType

import numpy as np
import pytest
from tests.shapes import block, level, wall

from lidarsim import (
    Actor,
    Fault,
    Gnss,
    Imu,
    Material,
    Mounted,
    Navigation,
    Noise,
    Pose,
    Returns,
    Scene,
    Sensor,
    Survey,
    Track,
)
from lidarsim.media.weather import Weather, raindrops, snowflakes
from lidarsim.motion.navigation import gnss_fixes, imu_samples
from lidarsim.numerics.random_numbers import Purpose, named_seed, raw, scan_states
from lidarsim.pulses.steps import particle_loops, pulse_loops, random_loops, spray_loops
from lidarsim.pulses.steps.losses import PACKET
from lidarsim.pulses.steps.range_noise import CHANNEL
from lidarsim.pulses.steps.waveform_samples import SAMPLE, SAMPLES
from lidarsim.simulator.rig import Rig
from raybeam.compiled import compiled

SENSOR = Sensor.grid(60, 8, step_deg=90, min_range_m=0.5, max_range_m=60)
NOISE = Noise(
    0.02, angle_deg=0.05, dropout=0.05, detection_range_m=150, range_at_threshold_m=0.05,
    walk_m=0.02, false_alarm_hz=2e6, stray_light=0.1, crosstalk=True, velocity_m_s=0.1, seed=3,
    channel_bias_m=0.01,
)  # fmt: skip
IMU = Imu(
    rate_hz=100, gyroscope_noise_density=1e-3, gyroscope_bias=1e-3, gyroscope_random_walk=1e-4,
    accelerometer_noise_density=0.01, accelerometer_bias=0.1, accelerometer_random_walk=0.01,
    scale=1e-3,
)  # fmt: skip
GNSS = Gnss(horizontal_m=1, drift_vertical_m=2, outages=[(0.1, 0.2)])


def everything():
    """A scene and a survey with every effect that draws random numbers."""
    meshes = [level("Ground")]
    for name, x in (("Crown 1", 5.0), ("Crown 2", 6.0), ("Sign", -4.0)):
        meshes.append(block(name, (3, 3, 3), (x, 0.3, 1.7)))
    other = Mounted(replace(SENSOR, start_ns=100.0), Pose((0, 0.5, 0)), name="right")
    way = Track([0, 0.5], [[5.0, -3, 0.7], [17, -3, 0.7]])
    van = Actor(block("Van", (4, 2, 1.4), (0, 0, 0)), way)
    return Scene.from_meshes(meshes).with_actors((van,)), Survey(
        sensors=[Mounted(SENSOR, name="left"), other],
        trajectory=Track([0, 0.5], [[0, 0, 1.2], [0.5, 0, 1.2]]),
        steps=4,
        materials=[
            Material("Sign", 0.5, retro=True),
            Material("Crown*", leaf_area_density=0.5),
            Material("*"),
        ],
        returns=Returns("all", 7, 20.0, waveform="peaks"),
        noise=NOISE,
        columns=["range", "cause", "radial_velocity"],
        waveform_samples=200,
        navigation=Navigation(imu=IMU, gnss=GNSS, seed=3),
        faults=[Fault("dropped_packets", share=0, packet=12)],
        fog_lidar_ratio_sr=18.8,
        visibility_km=0.5,
        snow_mm_h=1.0,
        wet=1.0,
        spray_g_m3=20.0,
    )


class Draws:
    """The bits that all functions draw, by their purpose."""

    def __init__(self):
        self.bits = {}  # {purpose: arrays}
        self._purposes = {}  # {hash state: purpose}
        self._compiled_bits = compiled()(random_loops.bits.py_func)

    def raw(self, seed, purpose, *key):
        bits = raw(seed, purpose, *key)
        self.bits.setdefault(purpose, []).append(np.ravel(bits))
        return bits

    def states(self, seed, purposes, scans):
        states = scan_states(seed, purposes, scans)
        for row in states.tolist():
            self._purposes.update(zip(row, purposes, strict=True))
        return states

    def hashed(self, state, *key):
        bits = self._compiled_bits(state, *key)
        purpose = self._purposes[int(state)]
        self.bits.setdefault(purpose, []).append(np.array([bits], np.uint64))
        return bits


def watch_arrays(monkeypatch, draws):
    """Have all modules draw arrays of random numbers by `draws`."""
    for name, module in [*sys.modules.items()]:
        if name.startswith("lidar"):
            for known, watched in ((raw, draws.raw), (scan_states, draws.states)):
                if getattr(module, known.__name__, None) is known:
                    monkeypatch.setattr(module, known.__name__, watched)


def watch_loops(monkeypatch, draws):
    """Have the loops that draw random numbers run in plain Python, and draw by `draws`."""
    # Some are private: every function is replaced by which a random number reaches a loop.
    sampling = {
        particle_loops: ["particle_energy", "sample_particles", "sample_fog"],
        spray_loops: ["particle_energy", "_column", "_guide", "sample_clumps"],
    }
    for loops, names in sampling.items():
        # Others are compiled without these.
        plain = vars(random_loops) | vars(loops) | {"bits": draws.hashed}
        functions = [random_loops.uniform, pulse_loops.scan_row, *(vars(loops)[n] for n in names)]
        for function in functions:
            code = function.py_func.__code__
            plain[code.co_name] = FunctionType(code, plain)
        for name in names:
            monkeypatch.setattr(loops, name, plain[name])


@pytest.mark.slow
def test_no_random_number_is_used_twice(monkeypatch):
    """With three kinds of particles: keys that differ have hashes that differ."""
    draws = Draws()
    watch_arrays(monkeypatch, draws)
    watch_loops(monkeypatch, draws)
    kinds = raindrops(20.0), snowflakes(1.0), raindrops(5.0)
    monkeypatch.setattr(Weather, "particles", property(lambda _: kinds))
    scene, survey = everything()
    for returns in Rig(scene, survey, "numpy").cast(0, survey.scan_count):
        assert len(returns.radial_velocity) > 1000
    assert len([*imu_samples(survey), *gnss_fixes(survey)]) == 2
    assert {*Purpose.declared.values()} == draws.bits.keys(), "all are tried"
    each = {purpose: np.concatenate(bits) for purpose, bits in draws.bits.items()}
    # Windows of one waveform share samples, returns of a channel its error, those of a packet its
    # fate.
    for again in (SAMPLES, SAMPLE, CHANNEL, PACKET):
        each[again] = np.unique(each[again])
    for purpose, bits in each.items():
        assert len(np.unique(bits)) == len(bits), purpose
    bits = np.concatenate([*each.values()])
    assert len(np.unique(bits)) == len(bits)


def test_seeds_of_names_are_the_same_on_every_machine():
    assert named_seed(7, "") == 7
    assert named_seed(0, "left") == 1296481425350128941
    assert named_seed(1, "hinten links ü") == 4561067770506489771


@pytest.mark.parametrize("keep_every", [1, 3])
def test_ranges_that_noise_moves_out_of_the_sensors_range_are_no_returns(keep_every):
    """Of walls at its greatest and near its least range; what is left has the same ranges."""
    walls = Scene.from_meshes([wall("Far", 60.0), wall("Near", -0.7)])
    sensor = Sensor.grid(360, 1, 0, step_deg=360, min_range_m=0.5, max_range_m=60.1)
    unlimited = Sensor.grid(360, 1, 0, step_deg=360, min_range_m=0.0)
    noise = Noise(0.3, seed=3)
    options = {"columns": ["range"], "keep_every": keep_every}
    made = []
    for lidar in (unlimited, sensor):
        survey = Survey(lidar, poses=[(0, 0, 0)], steps=1, noise=noise, **options)
        [batch] = Rig(walls, survey, "numpy").cast(0, 1)
        made.append((np.asarray(batch.range), np.asarray(batch.ray), batch))
    (_, _, _), (ranges, rays, batch) = made
    assert len(ranges) and (ranges >= 0.5).all() and (ranges <= 60.1).all()
    assert (np.diff(rays) > 0).all() and (batch.return_number == 1).all()
    if keep_every == 1:
        everything = made[0][0]
        inside = (everything >= 0.5) & (everything <= 60.1)
        within = np.isin(made[0][1], rays)
        assert (~inside).sum() > 0 and np.array_equal(everything[within], ranges)
        assert batch.hit_counts.sum() == batch.tally[1].sum() == len(ranges)
    else:
        assert batch.hit_counts.sum() >= len(ranges) * keep_every - keep_every


def test_numbers_of_returns_count_those_within_the_sensors_range():
    """Of two returns of a pulse, noise moves the second one beyond the greatest range."""
    meshes = [wall("Fence", 20.0, z=(-50, 0)), wall("Wall", 30.0)]
    sensor = Sensor.grid(400, 1, 0, 360, max_range_m=30.3, horizontal_fov_deg=10)
    survey = Survey(
        sensor, poses=[(0, 0, 0)], steps=1, returns=Returns("all", 7, 20.0),
        noise=Noise(0.2, seed=1), columns=["range", "return_number", "returns"],
    )  # fmt: skip
    [batch] = Rig(Scene.from_meshes(meshes), survey, "numpy").cast(0, 1)
    count = np.bincount(batch.ray.astype(np.int64))
    assert (batch.range <= 30.3).all() and batch.hit_counts.sum() == len(batch)
    assert np.array_equal(batch.returns, count[batch.ray]) and {*count} == {1, 2}
    first = np.append(True, np.diff(batch.ray) > 0)
    assert (batch.return_number[first] == 1).all() and (batch.return_number[~first] == 2).all()
