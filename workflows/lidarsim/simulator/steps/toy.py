"""A toy effect: all ranges are longer."""

from __future__ import annotations

from ..returns import PulseReturns, required
from .step import PulseBatch, PulseStep, Role, Setup


class ToyStep(PulseStep):
    """Adds a length to reported ranges."""

    role = Role.ON_REPORTED
    effects = ("Toy",)
    reads = ("reported",)
    writes = ("reported",)

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return True if ranges are longer."""
        return setup.noise.toy_m > 0

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Return the returns with longer ranges."""
        reported = returns.distance if returns.reported is None else required(returns.reported)
        return returns._replace(reported=reported + self.setup.noise.toy_m)
