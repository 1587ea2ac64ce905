"""The estimate of the memory that casting takes, against what it takes."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.shapes import BALL_AROUND as SCENE
from tests.shapes import SPIN_OF_128_BEAMS as MANY

from lidarsim import (
    Beams,
    Material,
    Mounted,
    Noise,
    Optics,
    Returns,
    Sensor,
    Spin,
    Survey,
    Track,
    load_sensor,
)
from lidarsim.simulator.memory import HIT_COUNTER, cast_bytes, scans_that_fit
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.survey.survey import OPTIONAL_NAMES

RAYS = 600_000

ONE = Sensor(Beams(np.zeros(1)), Spin(20_000))
STILL = {"poses": [(0, 0, 1)], "steps": 10_000}
WAY = {"trajectory": Track([0, 60], [(0, 0, 1), (2, 0, 1)], [[0, 0, 0, 1], [0, 0, 1, 0]])}
ALL = {"columns": OPTIONAL_NAMES}
HALF = [Material("*", 0.5)]
SEEN = {"noise": Noise(detection_range_m=100), "returns": Returns("dual", divergence_mrad=3.0)}
PAINT = {"columns": ["intensity", "red", "green", "blue"], "materials": [Material("*", "texture")]}
ALERT = replace(MANY, max_range_m=150.0, optics=Optics(divergence_mrad=3.0))
BOTH = [Mounted(ALERT, name="one"), Mounted(ALERT, name="other")]
FAINT = {"detection_range_m": 500.0}
EVERY = {"returns": Returns("all")}
SIGN = {"materials": [Material("Sign", 1.0, retro=True), Material("*", 0.5)]}

QUICK = ("positions", "one beam, on the move", "lost returns", "rain", "crosstalk")
SURVEYS = {
    "positions": Survey(MANY, **STILL),
    "all columns, on the move": Survey(MANY, **WAY, **ALL),
    "one beam, on the move": Survey(ONE, **WAY),
    "rays that never repeat": Survey(load_sensor("livox/mid40", step_deg=30), **STILL),
    "lost returns": Survey(MANY, **STILL, noise=Noise(dropout=0.01), materials=HALF),
    "colors": Survey(MANY, **STILL, **PAINT),
    "noise and colors": Survey(MANY, **STILL, **PAINT, noise=Noise(angle_deg=0.01)),
    "velocities of sub-rays": Survey(
        MANY, **WAY, columns=["radial_velocity"], returns=Returns("strongest", 7, 3.0)
    ),
    "leaves": Survey(
        MANY,
        **STILL,
        returns=Returns("all", 7, (3.0, 1.5), exit_diameter_m=0.01),
        materials=[Material("Ball", 0.5, leaf_area_density=0.02), *HALF],
    ),
    "water": Survey(
        MANY,
        **STILL,
        materials=[Material("Ball", 0.5, transparent="pass", refractive_index=1.33), *HALF],
    ),
    "ghosts": Survey(
        MANY, **STILL, **EVERY, materials=[Material("*", 0.5, specular_reflectance=0.3)]
    ),
    "false alarms": Survey(ALERT, **STILL, noise=Noise(**FAINT, false_alarm_hz=1e6), **EVERY),
    "stray light": Survey(ALERT, **WAY, noise=Noise(**FAINT, stray_light=1e-5), **SIGN),
    "saturation": Survey(MANY, **STILL, noise=Noise(**FAINT, saturation=10), materials=HALF),
    "crosstalk": Survey(sensors=BOTH, **STILL, noise=Noise(**FAINT, crosstalk=True)),
    "sub-rays": Survey(MANY, **STILL, **ALL, returns=Returns("strongest", 7, 3.0)),
    "rain": Survey(MANY, **STILL, **SEEN, rain_mm_h=20),
    "snow": Survey(MANY, **STILL, **ALL, **SEEN, snow_mm_h=2),
}


@pytest.mark.slow(keep=("positions",))
@pytest.mark.slow(keep=("positions", "one beam, on the move", "lost returns", "crosstalk", "rain"))
@pytest.mark.parametrize("name", SURVEYS)
def test_the_estimate_is_safe_and_near(name):
    survey = SURVEYS[name]
    rig = Rig(SCENE, survey, "tiles", threads=1)
    scans = RAYS // survey.scan(0).ray_count
    columns_of(list(rig.cast(0, 1)))  # what is made once
    tracemalloc.start()
    try:
        columns_of(list(rig.cast(0, scans)))
        taken = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert taken < cast_bytes(SCENE, survey, scans) < 1.5 * taken


@pytest.mark.extended
@given(st.floats(0, 1e10), st.sampled_from(sorted(SURVEYS)))
def test_as_many_scans_as_fit(limit, name):
    survey = SURVEYS[name]
    fit = scans_that_fit(SCENE, survey, limit)
    limit += HIT_COUNTER * SCENE.counters
    assert fit >= 1
    assert fit == 1 or cast_bytes(SCENE, survey, min(fit, survey.scan_count)) <= limit
    assert fit >= survey.scan_count or cast_bytes(SCENE, survey, fit + 1) > limit


def test_the_sensor_with_the_largest_scans_counts():
    both = Survey(sensors=[Mounted(ONE, name="one"), Mounted(MANY, name="many")], **STILL)
    alone = Survey(MANY, **STILL, columns=["sensor"])
    assert cast_bytes(SCENE, both) == cast_bytes(SCENE, alone)
