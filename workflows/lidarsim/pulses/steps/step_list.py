"""List of the simulation steps, in the order in which they act on pulses."""

from __future__ import annotations

from functools import reduce
from operator import or_

from ...scene.scene import Scene
from ...sensor.noise import Noise
from ...survey.survey import Survey
from .angle_noise import AngleNoiseStep, RippleStep
from .cast import CastStep
from .crosstalk import CrosstalkStep
from .detection import DetectionStep
from .false_alarms import FalseAlarmStep
from .losses import DirtStep, LossStep
from .particles import WeatherStep
from .range_noise import RangeNoiseStep
from .recorded import RecordedStep
from .saturation import SaturationStep
from .separation import SelectionStep, SeparationStep
from .spray import SprayStep
from .step import PulseStep, Role, Setup
from .stray_light import StrayLightStep
from .waveform import WaveformStep
from .waveform_samples import RecordingStep

# If no step applies, each ray has one return, which is its hit.
STEPS: list[type[PulseStep]] = [
    AngleNoiseStep,
    RippleStep,
    CastStep,  # follows light at mirrors, glass, water and leaves
    RecordedStep,  # recorded returns in place of the cast
    WeatherStep,  # rain, snow, fog and dust; casting/surfaces.py attenuates the light
    SprayStep,
    DirtStep,  # dirt on the window
    SeparationStep,  # combines hits into returns, without waveforms
    WaveformStep,  # combines hits into returns, with waveforms
    DetectionStep,
    StrayLightStep,
    FalseAlarmStep,
    CrosstalkStep,
    SaturationStep,
    LossStep,  # dead channels and lost packets
    SelectionStep,
    RecordingStep,
    RangeNoiseStep,
]


def setup_of(
    scene: Scene, survey: Survey, number: int, recorded_noise: Noise | None = None
) -> Setup:
    """Return the setup of a sensor, including the roles of the steps that apply to it.

    `recorded_noise` is set if the pulses are recorded (`Setup.recorded_noise`).
    """
    setup = Setup(scene, survey, number, None, recorded_noise)
    effects = [step for step in STEPS if Role.FRAME not in step.role and step.applies(setup)]
    roles = reduce(or_, (step.role for step in effects), Role(0))
    return Setup(scene, survey, number, roles, recorded_noise)


def steps_of(setup: Setup) -> list[type[PulseStep]]:
    """Return the steps that apply to a sensor."""
    return [step for step in STEPS if step.applies(setup)]


def received_causes() -> list[int]:
    """Return the causes of returns that the receiver adds, as indices into `CAUSES`.

    Such returns do not come from a point that reflects light, so they have no velocity.
    """
    return [cause for step in STEPS if Role.RECEIVES in step.role for cause in step.causes]


def add_step(step: type[PulseStep], before: type[PulseStep] | None = None) -> None:
    """Add a step from another package to all simulations in this process.

    Parameters
    ----------
    step
        A subclass of `PulseStep`.
    before
        The existing step before which the new step acts. The default depends on the role: steps
        that deflect beams act just before beams are cast, steps that change hits just before hits
        are combined into returns, steps that add received returns just before saturation, and steps
        that change reported returns at the end.

    Raises
    ------
    ValueError
        If the step would have no effect at its position, has the role `Role.FRAME`, or has already
        been added.

    Examples
    --------
    >>> class Dimmer(PulseStep):
    ...     role = Role.CHANGES
    ...     reads = writes = ("energy",)
    ...
    ...     @staticmethod
    ...     def applies(setup):
    ...         return setup.sensor.max_range_m > 100
    ...
    ...     def apply(self, returns, batch):
    ...         batch.hits = returns._replace(energy=returns.energy / 2)
    ...         return batch.hits
    >>> add_step(Dimmer)
    >>> STEPS.index(Dimmer) == STEPS.index(SeparationStep) - 1
    True
    >>> remove_step(Dimmer)
    """
    if step in STEPS:
        raise ValueError(f"step {step.__name__} has already been added")
    if Role.FRAME in step.role:
        raise ValueError(f"step {step.__name__} with {Role.FRAME} cannot be added. Set other roles")
    if before is None:
        before = next((following for role, following in _POSITIONS if role in step.role), None)
    position = len(STEPS) if before is None else STEPS.index(before)
    for role, first, last in _SPANS:
        if role in step.role and not STEPS.index(first) < position <= STEPS.index(last):
            raise ValueError(
                f"step {step.__name__} with {role} must be after {first.__name__}, but not after "
                f"{last.__name__}"
            )
    if Role.AIMS in step.role and position > STEPS.index(CastStep):
        raise ValueError(
            f"step {step.__name__} with {Role.AIMS} must be before {CastStep.__name__}"
        )
    STEPS.insert(position, step)


def remove_step(step: type[PulseStep]) -> None:
    """Remove a step that was added with `add_step`."""
    STEPS.remove(step)


# {role: step before which a step with this role is inserted}. The first match applies.
_POSITIONS = (
    (Role.AIMS, CastStep),
    (Role.RECEIVES, SaturationStep),
    (Role.CHANGES, SeparationStep),
)
# (role, first, last): a step with this role must act after `first` and not after `last`. Returns
# can be received once there are returns, and before `SelectionStep` selects returns.
_SPANS = (
    (Role.RECEIVES, DetectionStep, SelectionStep),
    (Role.CHANGES, CastStep, RangeNoiseStep),
)
