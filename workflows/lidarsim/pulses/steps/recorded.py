"""Returns of recorded pulses, which take the place of cast rays.

A recorded return keeps its range. Its energy is attenuated by the air of the survey. Bodies of the
scene, such as inserted cars, are cast by `CastStep`. In each sub-ray, the nearest opaque surface
hides everything behind it, whether it is recorded or cast.
"""

from __future__ import annotations

import numpy as np

from ...casting.scene_caster import SceneCaster
from ...casting.surfaces import SceneSurfaces, sensor_light_of
from ...numerics.arrays import Floats, Integers
from ...numerics.elementary import exp
from ...scene.colors import GRAY, pack_colors
from ..returns import RETURN_COLUMNS, PulseReturns, concatenate_returns
from .particles import light_reach
from .step import Memory, PulseBatch, PulseStep, Role, Setup, Sizes

RECORDED_TRIANGLE = 0  # triangle of recorded returns, whose object is invisible to the sensor


class RecordedStep(PulseStep):
    """Simulation step that adds the returns of recorded pulses to hits on inserted bodies."""

    role = Role.FRAME
    reads = "ray", "distance", "triangle"
    writes = *RETURN_COLUMNS, "source"

    def __init__(self, setup: Setup, caster: SceneCaster, surfaces: SceneSurfaces) -> None:
        super().__init__(setup, caster, surfaces)
        self._extinction = sensor_light_of(setup.survey, setup.sensor).extinction
        self._materials = surfaces.at_wavelength(setup.sensor.optics.simulated_nm)

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether pulses are recorded."""
        return setup.is_recorded

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """Return the memory of the returns in bytes."""
        return Memory(casting=60 * sizes.return_count)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Return the recorded returns of a batch, and the hits on bodies that are visible."""
        subrays = batch.subrays_per_beam
        recorded = self._recorded_returns(batch)
        if not len(returns.ray):
            batch.planes = self._planes(batch, recorded.ray)
            batch.hits = recorded
            return recorded
        assert batch.recorded is not None
        count = (batch.stop - batch.start) * subrays
        farthest_m = np.full(batch.stop - batch.start, np.inf)
        farthest_m[recorded.ray // subrays] = recorded.distance  # the last of each ray remains
        beam = returns.ray // subrays
        visible = returns.distance <= farthest_m[beam]
        visible &= batch.recorded.fired[batch.start + beam]
        batch.hits = returns
        bodies = batch.select(np.flatnonzero(visible))
        body_planes = batch.planes
        reach_m = light_reach(self._materials, self.surfaces, bodies, count)
        recorded = recorded.take(recorded.distance <= reach_m[recorded.ray])
        if bodies.color is not None:
            gray = np.full(len(recorded.ray), pack_colors(GRAY[0])[0])
            recorded = recorded._replace(color=gray)
        hits = concatenate_returns([bodies, recorded])
        order = np.lexsort((hits.distance, hits.ray))
        if body_planes is not None:
            planes = self._planes(batch, recorded.ray)
            assert planes is not None
            normals, directions = (
                np.concatenate(pair)[order] for pair in zip(body_planes, planes, strict=True)
            )
            batch.planes = normals, directions
        batch.hits = hits.take(order)
        return batch.hits

    def _recorded_returns(self, batch: PulseBatch) -> PulseReturns:
        """Return the recorded returns of a batch on all sub-rays."""
        recorded = batch.recorded
        assert recorded is not None
        start, stop = np.searchsorted(recorded.ray, [batch.start, batch.stop])
        distance = recorded.distance[start:stop]
        energy = recorded.energy[start:stop]
        if self._extinction:
            energy = energy * exp(-2 * self._extinction * distance)
        source = np.arange(start, stop, dtype=np.int32)
        beam = recorded.ray[start:stop] - batch.start
        subrays = batch.subrays_per_beam
        if subrays > 1:
            ray = (beam * subrays + np.arange(subrays)[:, None]).reshape(-1)
            order = np.argsort(ray, kind="stable")
            ray = ray[order]
            rows = np.tile(np.arange(len(beam)), subrays)[order]
            distance, energy, source = distance[rows], energy[rows], source[rows]
        else:
            ray = beam
        triangle = np.full(len(ray), RECORDED_TRIANGLE, np.int32)
        return PulseReturns(ray, distance, triangle, energy, source=source)

    def _planes(self, batch: PulseBatch, ray: Integers) -> tuple[Floats, Floats] | None:
        """Return planes through recorded returns that face the sensor.

        The result is None if beams have a single sub-ray.
        """
        if batch.subrays_per_beam == 1:
            return None
        _, directions = batch.subray_poses.rays(batch.beams, ray, batch.window[0])
        return -directions, directions
