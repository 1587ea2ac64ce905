"""Compiled loop that locates points in the range images of `ray_image`."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from raybeam.compiled import compiled


@compiled()
def find_pixels(ray, step, first_rays, ray_count, channels, plane, row, column):  # noqa: PLR0917 - a compiled loop
    """Compute the pixel index of each point.

    Writes the index of the point among the returns of its pulse to `plane`, its channel to `row`,
    and its firing to `column`. Each point belongs to ray `ray` of time step `step`. The first ray
    of each step is given by `first_rays`, and the image has `ray_count` rays. Returns the largest
    number of returns of a pulse, or -1 if the points are not in order or belong to other steps.
    """
    last_ray = -1
    returns = 0
    max_returns = 0
    firing = 0
    firing_start = 0  # first ray of the firing
    for k in range(len(ray)):
        if not 0 <= step[k] < len(first_rays):
            return -1
        ray_k = first_rays[step[k]] + ray[k]
        if ray_k < last_ray or ray_k >= ray_count:
            return -1
        while ray_k >= firing_start + channels:  # faster than a division
            firing_start += channels
            firing += 1
        returns = returns + 1 if ray_k == last_ray else 1
        max_returns = max(max_returns, returns)
        last_ray = ray_k
        plane[k] = returns - 1
        row[k] = ray_k - firing_start
        column[k] = firing
    return max_returns
