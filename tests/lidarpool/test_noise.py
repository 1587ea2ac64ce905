"""Every random number has one use."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import FunctionType

import numpy as np
from tests.shapes import block, level

from lidarpool import (
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
from lidarpool.sensor.navigation import fixes, imu_samples
from lidarpool.sensor.noise import Purpose, named_seed, raw, starts
from lidarpool.sensor.weather import Weather, rain, snow
from lidarpool.simulator import pulse_loops
from lidarpool.simulator.rig import Rig
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


def test_no_random_number_is_used_twice(monkeypatch):
    """With three kinds of particles: keys that differ have hashes that differ."""
    drawn, purposes, compiled_bits = {}, {}, compiled()(pulse_loops._bits.py_func)

    def recorded(seed, purpose, *key):
        bits = raw(seed, purpose, *key)
        drawn.setdefault(purpose, []).append(np.ravel(bits))
        return bits

    def begun(seed, *which):
        made = starts(seed, *which)
        purposes.update(zip(made.tolist(), which, strict=True))
        return made

    def hashed(start, *key):
        bits = compiled_bits(start, *key)
        drawn.setdefault(purposes[int(start)], []).append(np.array([bits], np.uint64))
        return bits

    for name, module in [*sys.modules.items()]:
        for known, other in ((raw, recorded), (starts, begun)):
            if name.startswith("lidarpool") and getattr(module, known.__name__, None) is known:
                monkeypatch.setattr(module, known.__name__, other)
    plain = vars(pulse_loops) | {"_bits": hashed}  # others are compiled without these
    for name in ("_uniform", "_scan_of", "_column", "particles", "fog", "spray"):
        plain[name] = FunctionType(getattr(pulse_loops, name).py_func.__code__, plain)
    for name in ("particles", "fog", "spray"):
        monkeypatch.setattr(pulse_loops, name, plain[name])
    kinds = rain(20.0), snow(1.0), rain(5.0)
    monkeypatch.setattr(Weather, "particles", property(lambda _: kinds))
    scene, survey = everything()
    for returns in Rig(scene, survey, "numpy").cast(0, survey.scan_count):
        assert len(returns.radial_velocity) > 1000
    assert len([*imu_samples(survey), *fixes(survey)]) == 2
    assert {*Purpose} == drawn.keys(), "all are tried"
    each = {purpose: np.concatenate(bits) for purpose, bits in drawn.items()}
    # Windows of one waveform share samples, returns of a channel its error, those of a packet its
    # fate.
    for again in (Purpose.SAMPLES, Purpose.SAMPLE, Purpose.CHANNEL, Purpose.PACKET):
        each[again] = np.unique(each[again])
    for purpose, bits in each.items():
        assert len(np.unique(bits)) == len(bits), purpose
    bits = np.concatenate([*each.values()])
    assert len(np.unique(bits)) == len(bits)


def test_seeds_of_names_are_the_same_on_every_machine():
    assert named_seed(7, "") == 7
    assert named_seed(0, "left") == 1296481425350128941
    assert named_seed(1, "hinten links ü") == 4561067770506489771
