"""Animations in glTF 2.0 files.

Samplers are implemented as in section 3.11 and appendix C of the specification.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ...numerics.arrays import AnyArray, Floats
from ...numerics.elementary import arctan2, sin
from ...numerics.vectors import norm
from ...words import did_you_mean
from .scene_graph import MeshFileError

# {target path: components of a value}. The number of weights depends on the mesh.
WIDTHS = {"translation": 3, "rotation": 4, "scale": 3}
_VALUES = {"LINEAR": 1, "STEP": 1, "CUBICSPLINE": 3}  # {interpolation: values per keyframe}

AnimatedNodes = dict[tuple[int, str], Floats]  # {(node, path): values at each time, (t, width)}


def find_animation(animations: list[dict[str, Any]], name: str) -> dict[str, Any]:
    """Return the animation with a given name.

    Animations without a name are identified by their number. An empty name selects the first
    animation.

    Raises
    ------
    MeshFileError
        If there is no such animation.
    """
    names = [str(animation.get("name") or number) for number, animation in enumerate(animations)]
    if not names:
        raise MeshFileError(
            "contains no animations. Export it with animations, or remove animation"
        )
    if name and name not in names:
        hint = did_you_mean(name, names).strip() or f"the animations are {', '.join(names[:8])}"
        raise MeshFileError(f"has no animation {name!r} ({hint})")
    return animations[names.index(name) if name else 0]


def keyframe_range(
    animation: Mapping[str, Any], read: Callable[[Any], AnyArray]
) -> tuple[float, float]:
    """Return the first and the last keyframe time of an animation.

    `read` returns the values of an accessor.

    Raises
    ------
    ValueError
        If keyframe times are not increasing.
    """
    times = [read(sampler["input"])[:, 0].astype(np.float64) for sampler in animation["samplers"]]
    if any((np.diff(t) <= 0).any() or not np.isfinite(t).all() for t in times):
        raise ValueError("the keyframe times of an animation must be finite and increasing")
    return min((t[0] for t in times), default=0.0), max((t[-1] for t in times), default=0.0)


def sample_channels(
    animation: Mapping[str, Any], at_s: Floats, read: Callable[[Any], AnyArray]
) -> AnimatedNodes:
    """Return the values of animated nodes at the given times.

    `at_s` has shape (t,), and `read` returns the values of an accessor.

    Raises
    ------
    ValueError
        If a keyframe has a wrong number of values.
    """
    channels: AnimatedNodes = {}
    for channel in animation["channels"]:
        target = channel["target"]
        sampler = animation["samplers"][channel["sampler"]]
        if "node" not in target or target["path"] not in (*WIDTHS, "weights"):
            continue  # targets defined by extensions do not affect triangles
        keys = read(sampler["input"])[:, 0].astype(np.float64)
        kind = sampler.get("interpolation", "LINEAR")
        path = target["path"]
        values = read(sampler["output"]).astype(np.float64)
        values = values.reshape(len(keys), _VALUES[kind], -1)
        if values.shape[2] != WIDTHS.get(path, values.shape[2]):
            raise ValueError(
                f"keyframes of a {path} must have {WIDTHS[path]} numbers, but have "
                f"{values.shape[2]}"
            )
        channels[target["node"], path] = _interpolate(keys, values, at_s, kind, path == "rotation")
    return channels


def _interpolate(
    keys: Floats, values: Floats, at_s: Floats, kind: str, are_rotations: bool
) -> Floats:
    """Interpolate keyframe values at the given times.

    Times have shape (t,), keyframe times have shape (k,), and the result has shape (t, w). Keyframe
    values have shape (k, 1, w), or (k, 3, w) for splines, which have an in-tangent, a value and an
    out-tangent for each keyframe.
    """
    start = np.searchsorted(keys, at_s, "right") - 1
    start = start.clip(0, max(len(keys) - 2, 0))
    stop = np.minimum(start + 1, len(keys) - 1)
    seconds = np.where(stop > start, keys[stop] - keys[start], 1.0)
    fraction = ((at_s - keys[start]) / seconds).clip(0, 1)[:, None]
    start_values, stop_values = (values[k, values.shape[1] // 2] for k in (start, stop))
    if kind == "STEP":
        sampled = np.where(fraction < 1, start_values, stop_values)
    elif kind == "CUBICSPLINE":
        start_slope = values[start, 2] * seconds[:, None]
        stop_slope = values[stop, 0] * seconds[:, None]
        square = fraction * fraction
        cube = fraction * fraction * fraction
        bend = (cube - 2 * square + fraction) * start_slope + (cube - square) * stop_slope
        sampled = (
            (2 * cube - 3 * square + 1) * start_values
            + (3 * square - 2 * cube) * stop_values
            + bend
        )
    elif are_rotations:
        sampled = _slerp(fraction, start_values, stop_values)
    else:
        sampled = (1 - fraction) * start_values + fraction * stop_values
    return sampled / norm(sampled)[:, None] if are_rotations else sampled


def _slerp(u: Floats, start: Floats, stop: Floats) -> Floats:
    """Interpolate between quaternions along the shorter rotation (Shoemake, 1985).

    Fractions have shape (t, 1), and quaternions have shape (t, 4).
    """
    start, stop = (q / norm(q)[:, None] for q in (start, stop))
    stop = np.where((start * stop).sum(axis=1, keepdims=True) < 0, -stop, stop)
    angle = 2 * arctan2(norm(stop - start), norm(stop + start))[:, None]
    sine = sin(angle)
    small = sine < 1e-9
    sine = np.where(small, 1.0, sine)
    start_fraction = np.where(small, 1 - u, sin((1 - u) * angle) / sine)
    stop_fraction = np.where(small, u, sin(u * angle) / sine)
    return np.asarray(start_fraction * start + stop_fraction * stop)
