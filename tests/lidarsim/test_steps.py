"""The list of steps: what each says of itself is what it does."""

from __future__ import annotations

import math
import re
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from tests.shapes import beam_along_x, cast, wall

from lidarsim import Fault, Material, Mounted, Noise, Returns, Scene, Survey, load_sensor
from lidarsim.columns.table import CAUSES
from lidarsim.motion.navigation import DRIVEN, OUTAGE, SKEW, WALK, WHITE
from lidarsim.numerics.random_numbers import Purpose
from lidarsim.pulses.returns import SURFACE, PulseReturns, merge_returns, returns_without_surface
from lidarsim.pulses.steps.cast import CastStep
from lidarsim.pulses.steps.doppler import VELOCITY
from lidarsim.pulses.steps.losses import DirtStep
from lidarsim.pulses.steps.step import PulseStep, Role
from lidarsim.pulses.steps.step_list import STEPS, add_step, received_causes, remove_step
from lidarsim.pulses.steps.waveform_samples import RecordingStep
from lidarsim.simulator.rig import Rig
from lidarsim.survey.survey import OPTIONAL_NAMES

EFFECTS = Path(__file__).parents[2] / "docs/effects.md"
# What is no step: figures for steps, a column, and files.
OTHERS = {"Data sheets", "Radial velocity", "Walking people", "Navigation"}
OF_OTHERS = {*(VELOCITY, WHITE, DRIVEN, WALK, SKEW, OUTAGE)}

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
RECEIVED = ["blooming", "crosstalk", "false alarm"]  # whose light shows no velocity
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
    assert {*used, *OF_OTHERS} == {*Purpose.declared.values()}
    numbers = [purpose.number for purpose in used]
    # Bytes of clouds depend on these.
    assert sorted(numbers) == [
        *range(1, 6),
        *range(10, 19),
        *range(20, 24),
        *range(30, 35),
        50,
        51,
        60,
        61,
    ]


def test_a_number_of_random_numbers_is_declared_once():
    with pytest.raises(
        ValueError,
        match=(
            r"^random number stream 2 is already used for .* 'again' requires a different "
            r"number$"
        ),
    ):
        Purpose(2, "again")


def test_each_cause_is_of_one_step():
    causes = [cause for step in STEPS for cause in step.causes]
    assert sorted([SURFACE, *causes]) == [*range(len(CAUSES))]
    assert sorted(CAUSES[cause] for cause in received_causes()) == RECEIVED


def same(one, other):
    if one is None or other is None:
        return one is other
    if one.dtype.names:
        return one.tobytes() == other.tobytes()
    return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


class Watched:
    """A step that is applied again, with other values in columns that it does not read."""

    def __init__(self, step):
        self._step = step
        self.role = step.role

    def apply(self, returns, batch):
        step = self._step
        before = (batch.hits, batch.planes, batch.air)
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
                one = getattr(made, column)
                other = getattr(again, column)
                assert same(one, other), (type(step), name, column)
        return made


@pytest.mark.extended
@pytest.mark.parametrize("name", SURVEYS)
def test_steps_read_and_write_what_they_say(name):
    rig = Rig(Scene.seed(), SURVEYS[name], "tiles", threads=1)
    pulses = rig.pulse_casters[0]
    assert {type(step) for step in pulses.steps} == {
        step for step in STEPS if step.applies(pulses.setup)
    }
    pulses.steps = [Watched(step) for step in pulses.steps]
    assert sum(map(len, rig.cast(0, 6))) > 500


@pytest.mark.extended
def test_a_survey_without_effects_has_no_steps():
    (pulses,) = Rig(Scene.seed(), Survey(poses=[(0, 0, 1)]), "numpy").pulse_casters
    assert pulses.steps == []


# -- steps of other packages ----------------------------------------------------------------------

ADDED_M = 0.5
WALL_M = 10.0
BEAMS = 8
SHOWN = "ray", "range", "intensity", "cause"


class Everywhere(PulseStep):
    """A step that applies to every sensor."""

    role = Role.FRAME

    @staticmethod
    def applies(setup):
        return True


class HalfOfReturns(Everywhere):
    """Loses the hits of every second beam, and half of the energy of the others."""

    role = Role.CHANGES

    def apply(self, returns, batch):
        hits = batch.select(np.flatnonzero(returns.ray // batch.subrays_per_beam % 2 == 0))
        batch.hits = hits._replace(energy=hits.energy / 2)
        return batch.hits


class Echo(Everywhere):
    """Adds a return of each pulse, in front of the wall."""

    role = Role.RECEIVES

    def apply(self, returns, batch):
        rays = np.arange(batch.start, batch.stop)
        distance = np.full(len(rays), ADDED_M)
        energy = np.full(len(rays), 0.125)
        return merge_returns(returns, returns_without_surface(returns, rays, distance, energy, 2))


class Aside(Everywhere):
    """Turns beams to the left by an angle whose tangent is 0.1."""

    role = Role.AIMS | Role.ABOUT_AXIS

    def apply(self, returns, batch):
        batch.deflect(np.tile([0.1, 0.0], (batch.stop - batch.start, 1)))
        return returns


class Farther(Everywhere):
    """Reports all ranges a meter longer."""

    role = Role.ON_REPORTED

    def apply(self, returns, batch):
        return returns._replace(reported=returns.reported + 1)


@contextmanager
def added(*steps):
    """Add steps, and remove them at the end."""
    for step in steps:
        add_step(step)
    try:
        yield
    finally:
        for step in steps:
            remove_step(step)


def points(*steps, mode="all", subrays=1, **options):
    """Points of beams along x, which hit a wall, where steps apply as well."""
    given = {"returns": Returns(mode, subrays, 1.0), "columns": SHOWN} | options
    with added(*steps):
        return cast([wall("Wall", WALL_M)], beam_along_x(BEAMS), **given)


@pytest.mark.parametrize("subrays", [1, 7])
def test_a_foreign_step_that_changes_returns_acts(subrays):
    plain = points(subrays=subrays)
    halved = points(HalfOfReturns, subrays=subrays)
    assert plain["ray"].tolist() == [*range(BEAMS)]
    assert halved["ray"].tolist() == [*range(0, BEAMS, 2)]
    assert np.array_equal(halved["intensity"], plain["intensity"][::2] / 2)


@pytest.mark.parametrize("subrays", [1, 7])
@pytest.mark.parametrize(
    ("mode", "ranges"),
    [("all", [ADDED_M, WALL_M]), ("first", [ADDED_M]), ("last", [WALL_M])],
)
def test_a_foreign_step_that_adds_returns_acts_before_some_are_selected(mode, ranges, subrays):
    echoes = points(Echo, mode=mode, subrays=subrays)
    assert echoes["range"] == pytest.approx(ranges * BEAMS, abs=1e-4)
    causes = {ADDED_M: 2, WALL_M: 0}
    assert echoes["cause"].tolist() == [causes[meters] for meters in ranges] * BEAMS


@pytest.mark.parametrize("subrays", [1, 7])
def test_a_foreign_step_that_turns_beams_acts(subrays):
    """On each beam, and beside the noise of angles."""
    turned = points(Aside, subrays=subrays)
    assert turned["range"] == pytest.approx([WALL_M * math.sqrt(1.01)] * BEAMS, rel=1e-6)
    noisy = Noise(angle_deg=0.01)
    both = points(Aside, subrays=subrays, noise=noisy)["range"]
    assert both == pytest.approx(turned["range"], abs=0.01)
    assert len(set(both.tolist())) == BEAMS, "the noise acts as well"


@pytest.mark.parametrize("subrays", [1, 7])
def test_a_foreign_step_of_kept_returns_acts(subrays):
    farther = points(Farther, subrays=subrays)
    assert farther["range"] == pytest.approx([WALL_M + 1] * BEAMS, rel=1e-6)


def test_foreign_steps_act_together():
    found = points(Farther, Aside, Echo, HalfOfReturns)
    wall_m = WALL_M * math.sqrt(1.01)
    ranges = [ADDED_M + 1, wall_m + 1, ADDED_M + 1] * (BEAMS // 2)
    assert found["range"] == pytest.approx(ranges, rel=1e-6)


def test_a_step_without_a_role_cannot_be_defined():
    with pytest.raises(TypeError, match=r"^step Silent has no role. Set `role` to flags of "):
        type("Silent", (PulseStep,), {})


def test_a_step_where_it_would_not_act_is_refused():
    for step, before in ((Echo, CastStep), (Echo, RecordingStep), (HalfOfReturns, CastStep)):
        with pytest.raises(ValueError, match=rf"^step {step.__name__} with Role.* must be after "):
            add_step(step, before)
    with pytest.raises(ValueError, match=r"^step Aside with Role.AIMS must be before CastStep"):
        add_step(Aside, DirtStep)
    with pytest.raises(ValueError, match=r"^step Everywhere with Role.FRAME cannot be added"):
        add_step(Everywhere)
    with pytest.raises(ValueError, match=r"^step DirtStep has already been added"):
        add_step(DirtStep)
    assert "Echo" not in [step.__name__ for step in STEPS]
