"""Errors of the emitted beam directions, which do not affect the reported directions."""

from __future__ import annotations

import numpy as np

from ...numerics.arrays import Floats, Integers
from ...numerics.elementary import sin_cos
from ...numerics.random_numbers import Purpose, normal
from ...numerics.vectors import hypot
from ...sensor.noise import Noise
from ..returns import PulseReturns
from .step import Memory, PulseBatch, PulseStep, Role, Setup, Sizes

ACROSS = Purpose(2, "horizontal noise of a beam direction")
UP = Purpose(3, "vertical noise of a beam direction")


class AngleNoiseStep(PulseStep):
    """Simulation step that rotates each beam by a random angle."""

    role = Role.AIMS
    purposes = ACROSS, UP
    on_recordings = (
        "`noise.angle_deg` cannot be simulated on a recording, because it changes where a beam "
        "hits the scene. Reconstruct the scene with `lidarpool twin`, and simulate the sensor in "
        "it."
    )

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether beam directions have random errors."""
        return setup.noise.angle_deg > 0

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """Return the memory of the beam directions, in bytes."""
        return beam_memory(setup, sizes)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Add random angles to the beams of a batch. The returns do not change."""
        beams = np.arange(batch.start, batch.stop)
        scan, ray = batch.keys.scan_and_number(beams)
        across, up = angle_errors(self.setup.noise, scan, ray)
        batch.deflect(np.column_stack([across, up]))
        return returns


class RippleStep(PulseStep):
    """Simulation step for azimuth errors that repeat with each revolution of the head."""

    role = Role.AIMS | Role.ABOUT_AXIS
    effects = ("Systematic errors",)
    on_recordings = (
        "`noise.ripple_deg` cannot be simulated on a recording, because it changes where a beam "
        "hits the scene. Reconstruct the scene with `lidarpool twin`, and simulate the sensor in "
        "it."
    )

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether azimuths have a periodic error."""
        return setup.noise.ripple_deg > 0

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """Return the memory of beam directions, or 0 if `AngleNoiseStep` already counts it."""
        return Memory() if setup.noise.angle_deg else beam_memory(setup, sizes)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Add azimuth errors to the beams of a batch. The returns do not change."""
        noise = self.setup.noise
        sensor = self.setup.sensor
        azimuth = sensor.head.azimuths(batch.firings.numbers[batch.row_range])
        sin, _ = sin_cos(noise.ripple_cycles * azimuth + np.radians(noise.ripple_phase_deg))
        # An azimuth error moves a beam sideways in proportion to the horizontal part of its
        # direction.
        level = hypot(*sensor.beam_directions.T[:2])
        across = ((np.radians(noise.ripple_deg) * sin)[:, None] * level).reshape(-1)
        batch.deflect(np.column_stack([across, np.zeros(len(across))]))
        return returns


def angle_errors(noise: Noise, scan: Integers, ray: Integers) -> tuple[Floats, Floats]:
    """Return the random horizontal and vertical angles of n beams, in radians.

    `scan` (n,) are scan numbers, and `ray` (n,) are the numbers of rays within their scans.
    """
    sigma = np.radians(noise.angle_deg)
    across = sigma * normal(noise.seed, ACROSS, scan, ray)
    up = sigma * normal(noise.seed, UP, scan, ray)
    return across, up


def beam_memory(setup: Setup, sizes: Sizes) -> Memory:
    """Return the memory of deflected beam directions, in bytes."""
    if setup.return_count_varies:  # the beams are deflected batch by batch
        return Memory()
    return Memory(retained=32 * sizes.rays, casting=20 * sizes.rays)
