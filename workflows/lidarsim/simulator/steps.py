"""The steps of the simulation, in the order in which they happen to a pulse."""

from __future__ import annotations

from .air import WeatherStep
from .angle_noise import AngleNoiseStep
from .crosstalk import CrosstalkStep
from .false_alarms import FalseAlarmStep
from .losses import DirtStep, LossStep
from .paths import CastStep
from .range_noise import RangeNoiseStep
from .recording import RecordingStep
from .saturation import SaturationStep
from .separation import SelectionStep, SeparationStep
from .spray import SprayStep
from .step import PulseStep, Setup
from .stray_light import StrayLightStep
from .waveform import DetectionStep, WaveformStep

# Where none applies, each ray has one return, its hit.
STEPS: tuple[type[PulseStep], ...] = (
    AngleNoiseStep,
    CastStep,  # with mirrors, glass, water and leaves
    WeatherStep,  # rain, snow, fog and dust
    SprayStep,
    DirtStep,  # on the window
    SeparationStep,  # hits to returns; or
    WaveformStep,
    DetectionStep,
    StrayLightStep,
    FalseAlarmStep,
    CrosstalkStep,
    SaturationStep,
    LossStep,  # dead channels and lost packets
    SelectionStep,
    RecordingStep,
    RangeNoiseStep,
)


def steps_of(setup: Setup) -> list[type[PulseStep]]:
    """Return the steps that apply to a sensor."""
    return [step for step in STEPS if step.applies(setup)]
