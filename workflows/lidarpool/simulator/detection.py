"""Which returns of waveforms are detected."""

from __future__ import annotations

from ..sensor.noise import Purpose
from .hits import Hits, numbers
from .step import Batch, Setup, Step


class Detection(Step):
    """Loses weak returns of waveforms, and a share of all; `Separation` does that itself."""

    reads = "ray", "amplitude"
    writes = ()
    purposes = Purpose.LOSS, Purpose.DETECTION

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `Step.applies`."""
        return setup.noise.loses and setup.in_waveforms

    def apply(self, returns: Hits, batch: Batch) -> Hits:
        """See `Step.apply`."""
        key = *batch.keys.of(returns.ray), numbers(returns.ray)
        return returns.take(self.setup.noise.detected(returns.height, *key))
