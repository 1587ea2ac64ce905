"""Moving objects near a submap, and their simulation in held-out sweeps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints

from .alignment import AlignedSweeps
from .held_out import HeldOutPulses, HeldOutRays
from .moving_objects import find_tracks
from .moving_rays import MovingRays, SweepMasks, pulse_times_s, return_times_s
from .object_surfels import ObjectHits, RecordedObject, cast_to_objects, reconstruct_objects
from .object_tracks import ObjectTrack, in_any_box
from .reflectances import Reflectances, Response

_STEP_S = 0.1  # step of the times at which objects are sought near a submap


class ObjectTask(NamedTuple):
    """Task of finding and reconstructing the moving objects according to some sweeps."""

    rays: MovingRays  # rays of the sweeps near moving objects
    labeled: Sequence[ObjectTrack] | None  # labeled boxes, or None to find the objects
    sweep_s: float  # typical time between the sweeps, seconds
    voxel_m: float  # edge length of the voxels of the scene, meters
    gap_rad: float  # angle between the rays of neighboring rings, radians


class ObjectMap(NamedTuple):
    """Moving objects according to some sweeps."""

    tracks: Sequence[ObjectTrack]
    objects: Sequence[RecordedObject]

    @classmethod
    def from_task(cls, task: ObjectTask) -> ObjectMap:
        """Find and reconstruct the moving objects."""
        tracks = find_tracks(task.rays, task.labeled, task.sweep_s)
        objects = reconstruct_objects(tracks, task.rays, task.voxel_m, task.gap_rad)
        # Points of objects that were found but have too few points remain as they are classified.
        return cls([one.track for one in objects] if task.labeled is None else tracks, objects)

    def between(self, times_s: Floats) -> ObjectMap:
        """Select what is present at one of the times at least."""
        return ObjectMap(
            present(self.tracks, times_s),
            [one for one in self.objects if one.track.is_present(times_s).any()],
        )


def present(tracks: Sequence[ObjectTrack], times_s: Floats) -> list[ObjectTrack]:
    """Select the tracks of objects that are present at one of the times at least."""
    return [track for track in tracks if track.is_present(times_s).any()]


class MovingObjects(NamedTuple):
    """Moving objects of a recording."""

    of_all: ObjectMap  # according to all sweeps
    of_mapped: ObjectMap  # according to the sweeps that form the map
    labeled: Sequence[ObjectTrack] | None  # boxes from labels, None without labels

    def between(
        self,
        first_s: float,
        last_s: float,
        air: SweepMasks,
        stationary: SweepMasks,
        stationary_in_mapped: SweepMasks,
    ) -> SubmapObjects:
        """Return the objects that are present between two times.

        The masks are those of a submap.
        """
        times_s = np.linspace(first_s, last_s, 2 + int((last_s - first_s) / _STEP_S))
        of_all = self.of_all.between(times_s)
        boxes = of_all.tracks if self.labeled is None else present(self.labeled, times_s)
        return SubmapObjects(
            air,
            stationary,
            stationary_in_mapped,
            of_all.tracks,
            boxes,
            self.of_mapped.between(times_s),
        )


@dataclass(frozen=True, eq=False)
class SubmapObjects:
    """Moving objects near a submap.

    Attributes
    ----------
    air
        Returns from the air. The other masks refer to the remaining points.
    masks, masks_of_mapped
        Points that are stationary according to the free space, in all sweeps and in the sweeps that
        form the map.
    tracks
        Tracks of the objects according to all sweeps.
    boxes
        Boxes in which held-out points are measured.
    of_mapped
        Objects according to the sweeps that form the map.
    """

    air: SweepMasks
    masks: SweepMasks
    masks_of_mapped: SweepMasks
    tracks: Sequence[ObjectTrack]
    boxes: Sequence[ObjectTrack]
    of_mapped: ObjectMap

    def stationary(self, sweeps: AlignedSweeps) -> dict[int, Bools]:
        """Return masks of the points that are not on moving objects, by sweep number."""
        return _without_objects(sweeps, self.masks.masks(), self.tracks)

    def stationary_in_mapped(self, sweeps: AlignedSweeps) -> dict[int, Bools]:
        """Return the same masks for the sweeps that form the map, which alone determine them."""
        return _without_objects(sweeps, self.masks_of_mapped.masks(), self.of_mapped.tracks)

    def simulate(
        self,
        sweeps: AlignedSweeps,
        rays: HeldOutRays,
        pulses: HeldOutPulses,
        response: Response | None,
    ) -> HeldOutRays:
        """Add the moving objects to the simulation of held-out sweeps.

        Parameters
        ----------
        sweeps
            All sweeps.
        rays
            Rays of the held-out sweeps, simulated without moving objects.
        pulses
            The pulses of the same rays, in the same order.
        response
            Response of the sensor, or None without intensities.
        """
        reflectances = [
            None
            if response is None
            else response.reflectances(one.observations, one.surfels.centers)
            for one in self.of_mapped.objects
        ]
        simulated_m = rays.simulated_m.copy()
        intensity = rays.simulated_intensity.copy()
        moving = np.zeros(len(simulated_m), bool)
        on_object = np.zeros(len(simulated_m), bool)
        start = 0
        for number, (returns, lost) in pulses.items():
            times_s = pulse_times_s(sweeps, number, returns, lost)
            rows = slice(start, start + len(times_s))
            count = len(returns.world)
            start = rows.stop
            moving[rows.start : rows.start + count] = in_any_box(
                self.boxes, sweeps.read(number).world, times_s[:count]
            )
            origins = np.concatenate([returns.origins, lost.origins])
            ends = np.concatenate([returns.world, lost.world])
            hits = cast_to_objects(self.of_mapped.objects, origins, ends, times_s)
            is_first = hits.distance_m < np.nan_to_num(simulated_m[rows], nan=np.inf)
            is_first &= hits.distance_m <= sweeps.coverage.max_range_m
            simulated_m[rows][is_first] = hits.distance_m[is_first]
            on_object[rows] = is_first
            for index in np.unique(hits.object[is_first]).tolist():
                chosen = is_first & (hits.object == index)
                intensity[rows][chosen] = _intensities(
                    reflectances[index], hits, rays.ring[rows], chosen
                )
        return replace(
            rays,
            simulated_m=simulated_m,
            simulated_intensity=intensity,
            standing=rays.standing & ~moving,
            moving=moving,
            on_object=on_object,
        )


def _intensities(
    reflectances: Reflectances | None, hits: ObjectHits, ring: Ints, chosen: Bools
) -> Floats:
    """Return the simulated intensities of the chosen hits, or NaN if they are unknown."""
    if reflectances is None:
        return np.full(int(chosen.sum()), np.nan)
    return reflectances.intensities(
        hits.surfel[chosen], hits.distance_m[chosen], hits.cosine[chosen], ring[chosen]
    )


def _without_objects(
    sweeps: AlignedSweeps, masks: Mapping[int, Bools], tracks: Sequence[ObjectTrack]
) -> dict[int, Bools]:
    """Remove the points in the boxes of moving objects from masks of stationary points."""
    found = {}
    for number, mask in masks.items():
        times_s = return_times_s(sweeps, number)
        found[number] = mask & ~in_any_box(tracks, sweeps.read(number).world, times_s)
    return found
