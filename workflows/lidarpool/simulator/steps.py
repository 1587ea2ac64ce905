"""The steps of the simulation, in the order in which they happen to a pulse."""

from __future__ import annotations

from .air import Weather
from .angle_noise import AngleNoise
from .crosstalk import Crosstalk
from .detection import Detection
from .false_alarms import FalseAlarms
from .paths import SubRays
from .range_noise import RangeNoise
from .recording import Recording
from .selection import Selection
from .separation import Separation
from .step import Setup, Step
from .stray_light import StrayLight
from .waveform import Waveforms

# Where none applies, each ray has one return, its hit.
STEPS: tuple[type[Step], ...] = (
    AngleNoise,
    SubRays,  # with mirrors, glass, water and leaves
    Weather,  # rain, snow, fog and dust
    Separation,  # hits to returns; or
    Waveforms,
    Detection,
    StrayLight,
    FalseAlarms,
    Crosstalk,
    Selection,
    Recording,
    RangeNoise,
)


def steps_of(setup: Setup) -> list[type[Step]]:
    """Return the steps that apply to a sensor."""
    return [step for step in STEPS if step.applies(setup)]
