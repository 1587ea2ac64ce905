"""Which returns of waveforms are detected."""

from __future__ import annotations

from ..sensor.noise import Purpose
from .returns import PulseReturns, numbers
from .step import PulseBatch, PulseStep, Setup


class DetectionStep(PulseStep):
    """Loses weak returns of waveforms, and a share of all; `SeparationStep` does that itself."""

    reads = "ray", "amplitude"
    writes = ()
    purposes = Purpose.LOSS, Purpose.DETECTION

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return setup.noise.loses and setup.in_waveforms

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        key = *batch.keys.of(returns.ray), numbers(returns.ray)
        return returns.take(self.setup.noise.detected(returns.height, *key))
