"""Animations of glTF 2.0: what samplers say at a time (specification, 3.11 and appendix C)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ...base.arrays import AnyArray, Floats
from ...base.elementary import arctan2, sin
from ...base.vectors import length
from ...base.words import did_you_mean
from .scene_graph import MeshFileError

WIDTHS = {"translation": 3, "rotation": 4, "scale": 3}  # numbers of a node; the rest are weights
_VALUES = {"LINEAR": 1, "STEP": 1, "CUBICSPLINE": 3}  # {interpolation: values of a key}

AnimatedNodes = dict[tuple[int, str], Floats]  # {(node, what): its values at each time, (t, width)}


def find_animation(animations: list[dict[str, Any]], name: str) -> dict[str, Any]:
    """Return the animation of a name, or of a number for those without names; "" for the first."""
    names = [str(one.get("name") or number) for number, one in enumerate(animations)]
    if not names:
        raise MeshFileError("has no animations: export it with them, or leave out animation")
    if name and name not in names:
        near = did_you_mean(name, names).strip() or f"there are {', '.join(names[:8])}"
        raise MeshFileError(f"has no animation {name!r} ({near})")
    return animations[names.index(name) if name else 0]


def keys_of(animation: Mapping[str, Any], read: Callable[[Any], AnyArray]) -> tuple[float, float]:
    """Return the first and last time of all keys; `read` gives the numbers of an accessor."""
    times = [read(sampler["input"])[:, 0].astype(np.float64) for sampler in animation["samplers"]]
    if any((np.diff(t) <= 0).any() or not np.isfinite(t).all() for t in times):
        raise ValueError("times of an animation do not ascend")
    return min((t[0] for t in times), default=0.0), max((t[-1] for t in times), default=0.0)


def sample_channels(
    animation: Mapping[str, Any], at_s: Floats, read: Callable[[Any], AnyArray]
) -> AnimatedNodes:
    """Return what an animation moves, at times (t,); `read` gives the numbers of an accessor."""
    found: AnimatedNodes = {}
    for channel in animation["channels"]:
        target = channel["target"]
        sampler = animation["samplers"][channel["sampler"]]
        if "node" not in target or target["path"] not in (*WIDTHS, "weights"):
            continue  # of extensions, which move nothing that reflects light
        keys = read(sampler["input"])[:, 0].astype(np.float64)
        kind = sampler.get("interpolation", "LINEAR")
        path = target["path"]
        values = read(sampler["output"]).astype(np.float64)
        values = values.reshape(len(keys), _VALUES[kind], -1)
        if values.shape[2] != WIDTHS.get(path, values.shape[2]):
            raise ValueError(f"keys of a {path} have {values.shape[2]} numbers, not {WIDTHS[path]}")
        found[target["node"], path] = _sampled(keys, values, at_s, kind, path == "rotation")
    return found


def _sampled(keys: Floats, values: Floats, at_s: Floats, kind: str, turns: bool) -> Floats:
    """Values (t, w) at times (t,) of keys (k,), with their tangents: (k, 3 or 1, w)."""
    begin = np.searchsorted(keys, at_s, "right") - 1
    begin = begin.clip(0, max(len(keys) - 2, 0))
    end = np.minimum(begin + 1, len(keys) - 1)
    seconds = np.where(end > begin, keys[end] - keys[begin], 1.0)
    share = ((at_s - keys[begin]) / seconds).clip(0, 1)[:, None]
    one, other = (values[k, values.shape[1] // 2] for k in (begin, end))
    if kind == "STEP":
        found = np.where(share < 1, one, other)
    elif kind == "CUBICSPLINE":
        out, into = (values[k, at] * seconds[:, None] for k, at in ((begin, 2), (end, 0)))
        square = share * share
        cube = share * share * share
        bend = (cube - 2 * square + share) * out + (cube - square) * into
        found = (2 * cube - 3 * square + 1) * one + (3 * square - 2 * cube) * other + bend
    elif turns:
        found = _slerp(share, one, other)
    else:
        found = (1 - share) * one + share * other
    return found / length(found)[:, None] if turns else found


def _slerp(u: Floats, one: Floats, other: Floats) -> Floats:
    """Quaternions (t, 4) at shares (t, 1) of the shorter turn (Shoemake, 1985)."""
    one, other = (q / length(q)[:, None] for q in (one, other))
    other = np.where((one * other).sum(axis=1, keepdims=True) < 0, -other, other)
    angle = 2 * arctan2(length(other - one), length(other + one))[:, None]
    sine = sin(angle)
    small = sine < 1e-9
    sine = np.where(small, 1.0, sine)
    first = np.where(small, 1 - u, sin((1 - u) * angle) / sine)
    return np.asarray(first * one + np.where(small, u, sin(u * angle) / sine) * other)
