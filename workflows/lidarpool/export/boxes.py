"""Boxes of actors in single sweeps, for labels of data sets and markers."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from ..base.arrays import Bools, Floats, Ints
from ..columns.cloud import Cloud
from ..sensor.trajectory import matrices
from .sweeps import Sweeps


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes of all actors in a sweep, at the time of their points.

    An actor moves during a sweep. Its box is at its pose at the mean time of its points, by their
    scans if the cloud has no times, or at the start of the sweep if it has none.
    """

    centres: Floats  # (a, 3): metres, world coordinates
    quaternions: Floats  # (a, 4): x, y, z, w of the rotation from the actor's axes to the world's
    sizes: Floats  # (a, 3): length, width and height, metres, along the actor's axes
    points: Ints  # (a,): how many points of the sweep are the actor's
    there: Bools  # (a,): whether it is in the scene

    @classmethod
    def of(cls, sweeps: Sweeps, sweep: int, points: Cloud) -> Boxes:
        """Return the boxes of a sweep, whose points are given."""
        count = len(sweeps.actors)
        actor = points["object"].astype(np.int64) - len(sweeps.objects)
        rows = np.flatnonzero(actor >= 0)
        counts = np.bincount(actor[rows], minlength=count)
        begin, end = sweeps.begins_ns[sweep], sweeps.ends_ns[sweep]
        if "time" in points.columns:
            share = (points["time"][rows] - begin) / max(end - begin, 1.0)
        else:
            first, stop = sweeps.scans[sweep : sweep + 2]
            share = (points["scan"][rows] + 0.5 - first) / (stop - first)
        share = (np.bincount(actor[rows], share, count) / np.maximum(counts, 1))[:, None]
        pair = [sweep, sweep + len(sweeps)]  # poses at its start and end
        places, turns = (
            np.array([getattr(pose, what)[pair] for pose in sweeps.actor_poses]).reshape(-1, 2, n)
            for what, n in (("positions", 3), ("quaternions", 4))
        )
        turns[(turns[:, 0] * turns[:, 1]).sum(axis=1) < 0, 1] *= -1
        place, turn = ((p[:, 0] + share * (p[:, 1] - p[:, 0])) for p in (places, turns))
        turn /= np.linalg.norm(turn, axis=1, keepdims=True)
        low, high = sweeps.actor_bounds[:, 0], sweeps.actor_bounds[:, 1]
        middle = (matrices(turn) @ ((low + high) / 2)[..., None])[..., 0]
        return cls(
            place + middle, turn, high - low, counts, sweeps.actor_there[:, sweep] | (counts > 0)
        )


def type_of(name: str) -> str:
    """Type of an actor for labels: its name without spaces, and a number or identity at the end.

    Examples
    --------
    >>> [type_of(name) for name in ("Car 1", "Car (b.2)", "Delivery van", "7")]
    ['Car', 'Car', 'Delivery_van', '7']
    """
    plain = re.sub(r"(\s*\([^()]*\)|[\s._-]*\d+)$", "", name.strip())
    return re.sub(r"\s+", "_", plain or name.strip())
