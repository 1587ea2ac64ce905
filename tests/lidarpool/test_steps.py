"""The list of steps: what each says of itself is what it does."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from lidarpool import Fault, Material, Mounted, Noise, Returns, Scene, Survey, load_sensor
from lidarsim.sensor.noise import Purpose
from lidarsim.sensor.survey import OPTIONAL_NAMES
from lidarsim.simulator.returns import PulseReturns
from lidarsim.simulator.rig import Rig
from lidarsim.simulator.steps import STEPS

EFFECTS = Path(__file__).parents[2] / "docs/effects.md"
# What is no step: figures for steps, a column, and files.
OTHERS = {"Data sheets", "Radial velocity", "People who walk", "Navigation"}
OF_OTHERS = {
    *(Purpose.VELOCITY, Purpose.WHITE, Purpose.DRIVEN, Purpose.WALK, Purpose.SKEW, Purpose.OUTAGE)
}

NOISE = Noise(
    range_m=0.02,
    angle_deg=0.02,
    dropout=0.05,
    detection_range_m=150.0,
    range_at_threshold_m=0.05,
    false_alarm_hz=1e5,
    stray_light=1e-4,
    crosstalk=True,
    saturation=100,
    channel_bias_m=0.01,
    ripple_deg=0.02,
)
FAULTS = [
    Fault("dirt", transmission=0.5),
    Fault("dead_channels", channels=[3]),
    Fault("dropped_packets", share=0.1, packet=12),
]
LIDAR = load_sensor("velodyne/vlp16")
COMMON = {
    "sensors": [Mounted(LIDAR, name="one"), Mounted(LIDAR, name="other")],
    "poses": [(0, 0, 2)],
    "columns": OPTIONAL_NAMES,
    "materials": [Material("Sphere", 0.9, retro=True), Material("*", 0.4)],
    "noise": NOISE,
    "rain_mm_h": 20,
    "faults": FAULTS,
}
SURVEYS = {
    "hits": Survey(**COMMON, returns=Returns("dual", 7)),
    "waveforms": Survey(**COMMON, returns=Returns("all", 7, waveform="gaussian")),
}


def test_effects_of_steps_are_those_of_the_documentation():
    sections = set(re.findall(r"^## (.+)$", EFFECTS.read_text("utf-8"), re.M))
    assert {effect for step in STEPS for effect in step.effects} == sections - OTHERS
    assert sections > OTHERS


def test_random_numbers_belong_to_one_step():
    """`DetectionStep` takes the place of a part of `SeparationStep`; they never apply together."""
    steps = [step for step in STEPS if step.__name__ != "DetectionStep"]
    used = [purpose for step in steps for purpose in step.purposes]
    assert len(used) == len(set(used))
    assert {*used, *OF_OTHERS} == set(Purpose)


def same(one, other):
    if one is None or other is None:
        return one is other
    if one.dtype.names:
        return one.tobytes() == other.tobytes()
    return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


class Watched:
    """A step that is applied again, with other values in columns that it does not read."""

    def __init__(self, step):
        self._step, self.of_kept = step, step.of_kept

    def apply(self, returns, batch):
        step, before = self._step, (batch.hits, batch.planes, batch.air)
        made = step.apply(returns, batch)
        after = batch.hits, batch.planes, batch.air
        new = {name for name, one in made._asdict().items() if one is not None}
        new -= {name for name, one in returns._asdict().items() if one is not None}
        assert new <= {*step.writes}, (type(step), new)
        if len(made.ray) == len(returns.ray):
            for name in {*PulseReturns._fields} - {*step.writes}:
                assert same(getattr(made, name), getattr(returns, name)), (type(step), name)
        for name in {*PulseReturns._fields} - {*step.reads, "ray"}:
            if getattr(returns, name) is None:
                continue
            changed = returns._replace(**{name: np.zeros_like(getattr(returns, name))})
            batch.hits, batch.planes, batch.air = before
            again = step.apply(changed, batch)
            batch.hits, batch.planes, batch.air = after
            for column in {*PulseReturns._fields} - {name}:
                one, other = getattr(made, column), getattr(again, column)
                assert same(one, other), (type(step), name, column)
        return made


@pytest.mark.parametrize("name", SURVEYS)
def test_steps_read_and_write_what_they_say(name):
    rig = Rig(Scene.seed(), SURVEYS[name], "embree", threads=1)
    pulses = rig._pulses[0]
    assert {type(step) for step in pulses.steps} == {
        step for step in STEPS if step.applies(pulses._setup)
    }
    pulses.steps = [Watched(step) for step in pulses.steps]
    assert sum(map(len, rig.cast(0, 6))) > 500


def test_a_survey_without_effects_has_no_steps():
    (pulses,) = Rig(Scene.seed(), Survey(poses=[(0, 0, 1)]), "numpy")._pulses
    assert pulses.steps == []
