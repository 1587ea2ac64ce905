"""Loop over returns that faults of a sensor take: see losses.py."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from raybeam.compiled import compiled


@compiled()
def remaining(ray, times, spans, firing, channel, row_indices):
    """Write the rows of returns that no fault takes, and return the number of rows.

    Rays `ray` (n,), in order, have firing times `times` (n,), nanoseconds. Each of f faults acts in
    a half-open span of times, `spans` (f, 2), and takes returns by masks of firings (f, firings)
    and channels (f, channels).
    """
    channels = channel.shape[1]
    count = 0
    number = 0
    begin = 0
    for k in range(len(ray)):
        while ray[k] >= begin + channels:  # rays follow each other
            number += 1
            begin += channels
        lost = False
        for f in range(len(spans)):
            if spans[f, 0] <= times[k] < spans[f, 1]:
                lost |= firing[f, number] or channel[f, ray[k] - begin]
        row_indices[count] = k
        count += int(not lost)
    return count
