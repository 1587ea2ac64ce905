"""Compiled loop that drops returns lost to sensor faults (losses.py)."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from raybeam.compiled import compiled


@compiled()
def remaining(ray, times, spans, firing, channel, row_indices):
    """Write the rows of returns that no fault removes, and return the number of rows.

    `ray` (n,) are sorted ray numbers, and `times` (n,) are firing times in nanoseconds. Each of f
    faults acts in a half-open time interval, `spans` (f, 2), on the firings and channels in the
    masks `firing` (f, firings) and `channel` (f, channels).
    """
    channels = channel.shape[1]
    count = 0
    number = 0
    begin = 0
    for k in range(len(ray)):
        while ray[k] >= begin + channels:  # rays are sorted
            number += 1
            begin += channels
        lost = False
        for f in range(len(spans)):
            if spans[f, 0] <= times[k] < spans[f, 1]:
                lost |= firing[f, number] or channel[f, ray[k] - begin]
        row_indices[count] = k
        count += int(not lost)
    return count
