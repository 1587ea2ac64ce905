"""The steps of the simulation, in the order in which they happen to a pulse."""

from __future__ import annotations

from .air import WeatherStep
from .angle_noise import AngleNoiseStep
from .crosstalk import CrosstalkStep
from .detection import DetectionStep
from .false_alarms import FalseAlarmStep
from .losses import DirtStep, LossStep
from .paths import CastStep
from .range_noise import RangeNoiseStep
from .recording import RecordingStep
from .saturation import SaturationStep
from .selection import SelectionStep
from .separation import SeparationStep
from .step import PulseStep, Setup
from .stray_light import StrayLightStep
from .waveform import WaveformStep

# Where none applies, each ray has one return, its hit.
STEPS: tuple[type[PulseStep], ...] = (
    AngleNoiseStep,
    CastStep,  # with mirrors, glass, water and leaves
    WeatherStep,  # rain, snow, fog and dust
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
