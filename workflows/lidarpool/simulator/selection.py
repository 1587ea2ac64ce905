"""Which returns of a pulse are reported."""

from __future__ import annotations

import numpy as np

from ..base.arrays import Bools, owned
from ..sensor.optics import Mode
from .returns import PulseReturns
from .step import PulseBatch, PulseStep, Setup

MODES: tuple[Mode, ...] = "all", "first", "last", "strongest", "dual"  # as of `pulse_loops`


class SelectionStep(PulseStep):
    """Reports some of a pulse's returns, after those that waveforms and receivers made."""

    reads = "ray", "energy", "amplitude"

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return setup.in_waveforms or setup.receives_more

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        return returns.take(chosen(returns, self.setup.reporting.mode))


def chosen(returns: PulseReturns, mode: Mode) -> Bools:
    """Whether a mode reports each return: (n,)."""
    from . import pulse_loops

    there, number = np.empty(len(returns.ray), np.bool_), MODES.index(mode)
    pulse_loops.reported(owned(returns.ray, np.int64), owned(returns.height), number, there)
    return there
