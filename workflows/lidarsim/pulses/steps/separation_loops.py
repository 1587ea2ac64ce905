"""Compiled loops that create, detect and select returns (separation.py)."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from raybeam.cast_record import float64s, int64s, uint8s
from raybeam.compiled import compiled, inlined, noinline

from ...numerics.arrays import Bools, Floats, Ints
from .pulse_loops import PulseHits, SurfaceMarks, beam_of, continue_surfaces, scan_row
from .random_loops import SHIFT_TO_INDEX, bits, uniform

# Modes, in the order of `separation.MODES`.
ALL, FIRST, LAST, STRONGEST, DUAL, TWO_STRONGEST = range(6)


class SubrayHits(NamedTuple):
    """Hits sorted by sub-ray.

    All arrays have shape (n,).
    """

    ray: Ints  # sub-ray
    distance: Floats  # meters
    energy: Floats  # energy as if the hit's sub-ray carried the whole beam
    velocity: Floats  # radial, m/s; empty if returns have no velocity
    solid: Bools  # False for hits on no surface; empty for the table of hits in the air


class Receiver(NamedTuple):
    """Receiver settings for resolution, detection and reporting."""

    subrays: int  # number of sub-rays per beam
    gap_m: float  # half of the pulse length; closer hits form one return
    mode: int  # which returns are reported
    with_velocity: bool  # whether returns have velocities
    dropout: float  # fraction of returns that are lost
    threshold: float  # energy at which half of the returns are detected; 0 without detection
    threshold_sigmas: float  # threshold in standard deviations of the noise
    quantiles: Floats  # quantiles of the normal distribution; empty without detection


class _Detection(NamedTuple):
    """Detection settings of a `Receiver`."""

    dropout: float  # fraction of returns that are lost
    threshold: float  # energy at which half of the returns are detected; 0 without detection
    threshold_sigmas: float  # threshold in standard deviations of the noise
    quantiles: Floats  # pointer to the quantiles of the normal distribution
    lowest: float  # first quantile
    highest: float  # last quantile


class _BeamKeys(NamedTuple):
    """Keys of the random numbers of a beam."""

    loss_state: np.uint64  # hash states of the beam's scan (`random_numbers.scan_states`)
    detection_state: np.uint64
    number_in_scan: int


class ReturnArrays(NamedTuple):
    """Output arrays for returns.

    All arrays have shape (k,).
    """

    beam: Ints  # number of the ray in the scans, counted from sub-ray 0
    row: Ints  # row of the strongest hit; -1, -2, … for hits in the air
    distance: Floats  # meters
    energy: Floats  # energy of the whole beam
    velocity: Floats  # radial, m/s

    def first(self, count: int) -> ReturnArrays:
        """Return the first `count` returns, without copying them."""
        return ReturnArrays(
            self.beam[:count],
            self.row[:count],
            self.distance[:count],
            self.energy[:count],
            self.velocity[:count],
        )


class _BeamRows(NamedTuple):
    """Row ranges of a beam's hits on surfaces and in the air."""

    start: int
    stop: int
    air_start: int
    air_stop: int


class _AirInBeam(NamedTuple):
    """Hits of a beam in the air."""

    stop: int  # first row of the next beam
    farthest_m: float  # distance of the farthest hit
    energy: float  # sum of the energies, as if each sub-ray carried the whole beam


class _BeamScratch(NamedTuple):
    """Scratch memory for the hits and returns of one beam."""

    hits: PulseHits  # row[k] is the row on surfaces, or -1, -2, … in the air
    marks: SurfaceMarks
    energy: Floats
    shown: Bools  # whether the mode reports a return


# Loops over all beams read and write through pointers, because numba counts references to arrays in
# tuples, which takes as long as the rest of the loop.
@inlined
def _pointers_to_hits(hits):
    """Return a `SubrayHits` with pointers to the arrays of `hits`, which must stay alive."""
    return SubrayHits(
        int64s(hits.ray.ctypes.data),
        float64s(hits.distance.ctypes.data),
        float64s(hits.energy.ctypes.data),
        float64s(hits.velocity.ctypes.data),
        uint8s(hits.solid.ctypes.data),
    )


@inlined
def _pointers_to_returns(output):
    """Return a `ReturnArrays` with pointers to the arrays of `output`, which must stay alive."""
    return ReturnArrays(
        int64s(output.beam.ctypes.data),
        int64s(output.row.ctypes.data),
        float64s(output.distance.ctypes.data),
        float64s(output.energy.ctypes.data),
        float64s(output.velocity.ctypes.data),
    )


@inlined
def _pointers_to_receiver(receiver):
    """Return a `Receiver` with a pointer to the quantiles of `receiver`, which must stay alive."""
    return Receiver(
        receiver.subrays,
        receiver.gap_m,
        receiver.mode,
        receiver.with_velocity,
        receiver.dropout,
        receiver.threshold,
        receiver.threshold_sigmas,
        float64s(receiver.quantiles.ctypes.data),
    )


@inlined
def _pointers_to_scratch(scratch):
    """Return a `_BeamScratch` with pointers to the arrays of `scratch`, which must stay alive."""
    hits = scratch.hits
    starts_return = uint8s(scratch.marks.starts_return.ctypes.data)
    return _BeamScratch(
        PulseHits(
            int64s(hits.subray.ctypes.data),
            float64s(hits.distance.ctypes.data),
            int64s(hits.row.ctypes.data),
            int64s(hits.return_begin.ctypes.data),
            int64s(hits.subray_hits.ctypes.data),
            int64s(hits.changes.ctypes.data),
        ),
        SurfaceMarks(uint8s(scratch.marks.solid.ctypes.data), starts_return, starts_return),
        float64s(scratch.energy.ctypes.data),
        uint8s(scratch.shown.ctypes.data),
    )


@noinline
def _max_hits(ray, subrays):
    """Return the maximum number of hits in `subrays` consecutive sub-rays.

    This is at least the maximum number of hits in a beam.
    """
    max_count = 0
    begin = 0
    end = -1
    for k in range(len(ray)):
        if ray[k] >= end:
            begin = k
            end = (beam_of(ray[k], subrays) + 1) * subrays
        max_count = max(max_count, k + 1 - begin)
    return max_count


@noinline
def _room_for_hits(size, subrays):
    pulse_hits = PulseHits(
        np.empty(size, np.int64),
        np.empty(size),
        np.empty(size, np.int64),
        np.empty(size, np.int64),
        np.empty(size * subrays, np.int64),
        np.empty(size + 1, np.int64),
    )
    starts_return = np.empty(size, np.bool_)
    return _BeamScratch(
        pulse_hits,
        SurfaceMarks(np.empty(size, np.bool_), starts_return, starts_return),
        np.empty(size),
        np.empty(size, np.bool_),
    )


@inlined
def _end_of_beam(ray, size, row, end_ray):
    """Return the first row, starting at `row`, whose sub-ray is at least `end_ray`."""
    while row < size and ray[row] < end_ray:
        row += 1
    return row


@inlined
def _air_in_beam(air, size, row, end_ray):
    """Return the hits in the air, starting at `row`, whose sub-rays are less than `end_ray`."""
    farthest_m = -np.inf
    energy = 0.0
    while row < size and air.ray[row] < end_ray:
        farthest_m = max(farthest_m, air.distance[row])
        energy += air.energy[row]
        row += 1
    return _AirInBeam(row, farthest_m, energy)


@inlined
def _single_return(hits, beam_rows, beam, receiver, count, output):
    """Write a single return for a beam if its surface hits are all within the receiver's gap.

    Returns whether the hits are within the gap, and the number of returns written so far.
    """
    nearest_m = np.inf
    farthest_m = -np.inf
    strongest = beam_rows.start
    has_energy = False
    sum_energy = 0.0
    sum_distance = 0.0
    sum_velocity = 0.0
    for k in range(beam_rows.start, beam_rows.stop):
        if hits.energy[k] > 0:
            nearest_m = min(nearest_m, hits.distance[k])
            farthest_m = max(farthest_m, hits.distance[k])
            sum_energy += hits.energy[k]
            sum_distance += hits.energy[k] * hits.distance[k]
            if receiver.with_velocity:
                sum_velocity += hits.energy[k] * hits.velocity[k]
            if not has_energy or hits.energy[k] > hits.energy[strongest]:
                strongest = k
            has_energy = True
    if not farthest_m - nearest_m <= receiver.gap_m:
        return False, count
    if has_energy:
        output.beam[count] = beam
        output.row[count] = strongest
        output.distance[count] = sum_distance / sum_energy
        output.energy[count] = sum_energy / receiver.subrays
        if receiver.with_velocity:
            output.velocity[count] = sum_velocity / sum_energy
        count += 1
    return True, count


@inlined
def _surely_detected(energy, detection):
    """Return whether a return is detected whatever the random numbers are."""
    return detection.dropout == 0 and (
        detection.threshold == 0
        or detection.threshold_sigmas * (energy / detection.threshold - 1) + detection.lowest > 0
    )


@inlined
def _outshines_air(distance, energy, air_in_beam, receiver, detection):
    """Return whether the only surface hit of a beam surely becomes the strongest return.

    Its return must be detected, be brighter than all hits in the air together, and be behind them.
    """
    return (
        # The margin allows for sums that are rounded differently.
        energy > 1.001 * air_in_beam.energy
        and distance - air_in_beam.farthest_m > receiver.gap_m
        and _surely_detected(energy / receiver.subrays, detection)
    )


@inlined
def _collect_hits(hits, air, beam_rows, scratch):
    """Write the hits of a beam that have energy to `scratch`, sorted by sub-ray.

    Within a sub-ray, hits in the air come first. Returns the number of hits, and the distance in
    meters between the nearest and the farthest hit.
    """
    row = scratch.hits.row
    distance = scratch.hits.distance
    energy = scratch.energy
    surface_row = beam_rows.start
    air_row = beam_rows.air_start
    count = 0
    nearest_m = np.inf
    farthest_m = -np.inf
    while surface_row < beam_rows.stop or air_row < beam_rows.air_stop:
        in_air = air_row < beam_rows.air_stop
        if in_air and (surface_row == beam_rows.stop or air.ray[air_row] <= hits.ray[surface_row]):
            row[count] = -1 - air_row
            distance[count] = air.distance[air_row]
            energy[count] = air.energy[air_row]
            air_row += 1
        else:
            row[count] = surface_row
            distance[count] = hits.distance[surface_row]
            energy[count] = hits.energy[surface_row]
            surface_row += 1
        if energy[count] > 0:
            nearest_m = min(nearest_m, distance[count])
            farthest_m = max(farthest_m, distance[count])
            count += 1
    return count, farthest_m - nearest_m


@inlined
def _sort_by_distance(scratch, count):
    """Sort the first `count` hits by distance, keeping the order of equal distances."""
    row = scratch.hits.row
    distance = scratch.hits.distance
    energy = scratch.energy
    for k in range(1, count):
        row_k = row[k]
        distance_k = distance[k]
        energy_k = energy[k]
        index = k
        while index > 0 and distance[index - 1] > distance_k:
            row[index] = row[index - 1]
            distance[index] = distance[index - 1]
            energy[index] = energy[index - 1]
            index -= 1
        row[index] = row_k
        distance[index] = distance_k
        energy[index] = energy_k


@inlined
def _mark_returns(count, exceeds_gap, receiver, scratch):
    """Mark the hits in `scratch` at which returns start.

    `count` is the number of hits. `exceeds_gap` is False if all hits of the beam are within the
    receiver's gap of each other. If beams have several sub-rays, `_in_several_returns` then
    finds the beams for which `continue_surfaces` must be called, because a surface that continues
    from sub-ray to sub-ray belongs to a single return.

    In the example of `continue_surfaces` with a gap of 0.3 m, `_collect_hits` has written the drop
    and then the hits of sub-rays 0 to 3, and `_sort_by_distance` has moved the post before the
    ground hits of sub-rays 1 and 2. `row` is -1, 0, 3, 1 and 2, because the drop is row 0 of the
    table of hits in the air. Each hit is farther than the gap from the previous one, so
    `starts_return` is True for all five. Because surface hits are in several returns,
    `continue_surfaces` looks for surfaces that continue, and clears `starts_return` of hits 2, 3
    and 4. `_write_returns` then writes two returns: the drop at 8.0 m, and hits 1 to 4 at their
    mean distance, weighted by energy. If the post returns twice the energy of a ground hit, the
    mean is 10.88 m, and the return has row 3, the row of the post.
    """
    distance = scratch.hits.distance
    starts_return = scratch.marks.starts_return
    for k in range(count):
        starts_return[k] = k == 0 or (
            exceeds_gap and distance[k] - distance[k - 1] > receiver.gap_m
        )


@inlined
def _in_several_returns(hits, air, count, scratch):
    """Return whether hits on surfaces are in several returns. Only then can a surface continue.

    Fills in the sub-rays of the first `count` hits in `scratch`, and whether they are solid.
    """
    row = scratch.hits.row
    solid = scratch.marks.solid
    several = False
    surface_number = -1
    number = 0
    for k in range(count):
        row_k = row[k]
        solid[k] = row_k >= 0 and hits.solid[row_k] != 0
        scratch.hits.subray[k] = hits.ray[row_k] if row_k >= 0 else air.ray[-1 - row_k]
        number += int(scratch.marks.starts_return[k])
        if solid[k]:
            several |= surface_number >= 0 and surface_number != number
            surface_number = number
    return several


@inlined
def _write_returns(hits, air, hit_count, beam, receiver, scratch, count, output):  # noqa: PLR0917 - a compiled loop
    """Write the returns of the first `hit_count` hits in `scratch`.

    Return the number of returns.
    """
    row = scratch.hits.row
    distance = scratch.hits.distance
    starts_return = scratch.marks.starts_return
    energy = scratch.energy
    k = 0
    while k < hit_count:
        strongest = k
        sum_energy = 0.0
        sum_distance = 0.0
        sum_velocity = 0.0
        while True:
            sum_energy += energy[k]
            sum_distance += energy[k] * distance[k]
            if receiver.with_velocity:
                velocity = hits.velocity[row[k]] if row[k] >= 0 else air.velocity[-1 - row[k]]
                sum_velocity += energy[k] * velocity
            if energy[k] > energy[strongest]:
                strongest = k
            k += 1
            if k == hit_count or starts_return[k]:
                break
        output.beam[count] = beam
        output.row[count] = row[strongest]
        output.distance[count] = sum_distance / sum_energy
        output.energy[count] = sum_energy / receiver.subrays
        if receiver.with_velocity:
            output.velocity[count] = sum_velocity / sum_energy
        count += 1
    return count


@inlined
def _keep(output, k, count):
    """Move return `k` behind the `count` kept returns, and return the new count."""
    if k == count:
        return count + 1
    output.beam[count] = output.beam[k]
    output.row[count] = output.row[k]
    output.distance[count] = output.distance[k]
    output.energy[count] = output.energy[k]
    output.velocity[count] = output.velocity[k]
    return count + 1


@inlined
def _detection_of(receiver):
    """Return the detection settings of a receiver."""
    count = len(receiver.quantiles)
    return _Detection(
        dropout=receiver.dropout,
        threshold=receiver.threshold,
        threshold_sigmas=receiver.threshold_sigmas,
        quantiles=float64s(receiver.quantiles.ctypes.data),
        lowest=receiver.quantiles[0] if count else 0.0,
        highest=receiver.quantiles[count - 1] if count else 0.0,
    )


@inlined
def _detected(energy, beam_keys, return_index, detection):
    """Return whether a return is detected, with the same result as `detection.is_detected`.

    The keys of the random number are `beam_keys`, and the `return_index` within the beam, from 0.
    """
    detected = (
        detection.dropout == 0
        or uniform(beam_keys.loss_state, beam_keys.number_in_scan, return_index)
        >= detection.dropout
    )
    if detected and detection.threshold > 0:
        signal = detection.threshold_sigmas * (energy / detection.threshold - 1)
        detected = signal + detection.lowest > 0  # detected with any random number
        if not detected and signal + detection.highest > 0:
            index = np.int64(
                bits(beam_keys.detection_state, beam_keys.number_in_scan, return_index)
                >> SHIFT_TO_INDEX
            )
            detected = signal + detection.quantiles[index] > 0
    return detected


@inlined
def _keep_detected(begin, stop, beam_keys, detection, output):
    """Keep the detected returns among rows `begin` to `stop`. Return the next free row."""
    count = begin
    for k in range(begin, stop):
        if _detected(output.energy[k], beam_keys, k - begin, detection):
            count = _keep(output, k, count)
    return count


@inlined
def _keep_strongest_detected(begin, stop, beam_keys, detection, lost, output):
    """Keep the strongest detected return among rows `begin` to `stop`. Return the next free row.

    Returns are tried in the order of their energy, which mostly takes a single random number.
    `lost` is scratch memory.
    """
    for k in range(begin, stop):
        lost[k - begin] = False
    for _ in range(begin, stop):
        strongest = -1
        for k in range(begin, stop):
            if not lost[k - begin] and (
                strongest < 0 or output.energy[k] > output.energy[strongest]
            ):
                strongest = k
        if _detected(output.energy[strongest], beam_keys, strongest - begin, detection):
            return _keep(output, strongest, begin)
        lost[strongest - begin] = True
    return begin


@noinline
def _mark(energy, begin, stop, mode, shown):
    """Mark the returns of a pulse that are reported in the given mode.

    Among returns of equal strength, the closest one is preferred.

    "Dual" reports the strongest and the last return. If the strongest return is the last, it also
    reports the second strongest. "Two strongest" reports the strongest and the second strongest.
    """
    strongest = begin
    second_strongest = -1
    for k in range(begin + 1, stop):
        if energy[k] > energy[strongest]:
            strongest = k
    if mode == TWO_STRONGEST or (mode == DUAL and strongest == stop - 1):
        for k in range(begin, stop):
            if k != strongest and (second_strongest < 0 or energy[k] > energy[second_strongest]):
                second_strongest = k
    for k in range(begin, stop):
        shown[k] = mode == ALL or k == second_strongest
    shown[begin] |= mode == FIRST
    shown[stop - 1] |= mode in (LAST, DUAL)
    shown[strongest] |= mode in (STRONGEST, DUAL, TWO_STRONGEST)


@inlined
def _start_of_scan(scan_starts, row):
    """Return the first beam of a scan, or the largest integer after the last scan."""
    return scan_starts[row] if row < len(scan_starts) else np.iinfo(np.int64).max


@inlined
def _keep_reported(begin, stop, mode, scratch, output):
    """Keep the returns of a beam that are reported in the given mode. Return the next free row."""
    for k in range(begin, stop):
        scratch.energy[k - begin] = output.energy[k]
    _mark(scratch.energy, 0, stop - begin, mode, scratch.shown)
    count = begin
    for k in range(begin, stop):
        if scratch.shown[k - begin]:
            count = _keep(output, k, count)
    return count


@compiled()
def mark_reported(ray, energy, mode, shown):
    """Mark in `shown` the returns that are reported in the given mode.

    The returns are sorted by ray.
    """
    begin = 0
    while begin < len(ray):
        stop = begin + 1
        while stop < len(ray) and ray[stop] == ray[begin]:
            stop += 1
        if stop == begin + 1:  # the call would take most of the time
            shown[begin] = True
        else:
            _mark(energy, begin, stop, mode, shown)
        begin = stop


@inlined
def _separate_beams(hits, air, neighbors, receiver, keys, scratch, output):  # noqa: C901, PLR0914, PLR0915 - a compiled loop
    """Separate the hits of all beams, as in `separate`, with the scratch memory of one beam."""
    subrays = receiver.subrays
    hit_count = len(hits.ray)
    air_count = len(air.ray)
    hits = _pointers_to_hits(hits)
    air = _pointers_to_hits(air)
    scratch = _pointers_to_scratch(scratch)
    output = _pointers_to_returns(output)
    loses = keys.states.shape[1] > 0
    detection = _detection_of(receiver)
    receiver = _pointers_to_receiver(receiver)
    has_neighbors = len(neighbors.pairs) > 0
    loss_state = np.uint64(0)
    detection_state = np.uint64(0)
    row = 0
    air_row = 0
    count = 0
    scan_index = 0
    scan_stop = -1  # first beam of the next scan
    scan_start = 0
    while row < hit_count or air_row < air_count:
        beam = beam_of(hits.ray[row] if row < hit_count else air.ray[air_row], subrays)
        if air_row < air_count:
            beam = min(beam, beam_of(air.ray[air_row], subrays))
        end_ray = (beam + 1) * subrays
        stop = _end_of_beam(hits.ray, hit_count, row, end_ray)
        air_in_beam = _air_in_beam(air, air_count, air_row, end_ray)
        beam_rows = _BeamRows(row, stop, air_row, air_in_beam.stop)
        row = stop
        air_row = air_in_beam.stop
        begin = count
        single = False
        # Mostly, there is one surface, and hits in the air are faint.
        outshines_air = (
            receiver.mode == STRONGEST
            and stop == beam_rows.start + 1
            and _outshines_air(
                hits.distance[stop - 1], hits.energy[stop - 1], air_in_beam, receiver, detection
            )
        )
        if outshines_air or air_row == beam_rows.air_start:
            single, count = _single_return(hits, beam_rows, beam, receiver, count, output)
        if not single:
            collected, extent_m = _collect_hits(hits, air, beam_rows, scratch)
            exceeds_gap = extent_m > receiver.gap_m
            if exceeds_gap:  # only few beams hit an edge or graze a surface
                _sort_by_distance(scratch, collected)
            _mark_returns(collected, exceeds_gap, receiver, scratch)
            if has_neighbors and _in_several_returns(hits, air, collected, scratch):
                continue_surfaces(
                    0, collected, scratch.marks, scratch.hits, receiver.gap_m, neighbors
                )
            count = _write_returns(hits, air, collected, beam, receiver, scratch, count, output)
        if loses and count > begin and not outshines_air:
            number = keys.first + beam
            if number >= scan_stop:
                scan_index = scan_row(keys.scan_starts, number, scan_index)
                scan_start = keys.scan_starts[scan_index]
                scan_stop = _start_of_scan(keys.scan_starts, scan_index + 1)
                loss_state = keys.states[scan_index, 0]
                detection_state = keys.states[scan_index, 1]
            beam_keys = _BeamKeys(loss_state, detection_state, number - scan_start)
            if receiver.mode == STRONGEST and count - begin > 1:
                count = _keep_strongest_detected(
                    begin, count, beam_keys, detection, scratch.shown, output
                )
            else:
                count = _keep_detected(begin, count, beam_keys, detection, output)
        if receiver.mode != ALL and count - begin > 1:
            count = _keep_reported(begin, count, receiver.mode, scratch, output)
    return count


@compiled()
def separate(hits, air, neighbors, receiver, keys, output):
    """Combine the hits of beams into returns, and write these to `output`.

    `hits` and `air` are `SubrayHits` on surfaces and in the air, `neighbors` is a
    `SubrayNeighbors`, `receiver` a `Receiver`, and `output` a `ReturnArrays`. `keys` is a
    `RandomKeys`, which has purposes if returns can be lost. Beams are numbered from 0 at sub-ray 0,
    and beam 0 is beam `keys.first` of the scans in `keys`. Returns the number of returns.
    """
    subrays = receiver.subrays
    size = _max_hits(hits.ray, subrays) + _max_hits(air.ray, subrays)
    scratch = _room_for_hits(size, subrays)
    return _separate_beams(hits, air, neighbors, receiver, keys, scratch, output)
