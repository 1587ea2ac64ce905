"""Simulate effects on the sweeps of a recording."""

from __future__ import annotations

from lidarsim.sensor import Sensor

from ..clouds.recording import Recording
from .augmented_sweep import AugmentedSweep
from .effects import Effects


class Augmenter:
    """Simulates effects on the sweeps of a recording.

    Parameters
    ----------
    recording
        The recording, opened with all points of its file (`keep_noise`).
    effects
        Effects to simulate.
    model
        Model of the recording's sensor, or None if it is unknown.
    """

    def __init__(self, recording: Recording, effects: Effects, model: Sensor | None = None) -> None:
        self.recording = recording
        self.effects = effects
        self.notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.recording)

    def sweep(self, number: int) -> AugmentedSweep:
        """Augment a sweep."""
        raise NotImplementedError
