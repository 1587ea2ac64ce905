"""Synthetic recordings of a street, whose energies are known."""

from __future__ import annotations

import numpy as np
from tests.made_recordings import made_recording

from lidarsim.columns.sweep import Sweep
from lidarsim.media.materials import normal_incidence_energy

HEIGHT_M = 1.8  # of the sensor above the ground
COUNT = 20_000


def street(seed=0, threshold=0.0, brightness=1.0):
    """Return points on level ground and walls, and the energies of their returns.

    Reflectances are between 0.05 and 0.9, multiplied by `brightness`.
    """
    rng = np.random.default_rng(seed)
    range_m = np.exp(rng.uniform(np.log(2.5), np.log(90), COUNT))
    azimuth = rng.uniform(-np.pi, np.pi, COUNT)
    is_ground = rng.random(COUNT) < 0.6
    elevation = np.where(is_ground, -np.arcsin(HEIGHT_M / range_m), rng.uniform(0, 0.2, COUNT))
    level = range_m * np.cos(elevation)
    points = np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), range_m * np.sin(elevation)], axis=1
    )
    cosine = np.where(is_ground, HEIGHT_M / range_m, rng.uniform(0.3, 1, COUNT))
    reflectance = brightness * np.exp(rng.uniform(np.log(0.05), np.log(0.9), COUNT))
    energy = reflectance * cosine * normal_incidence_energy(range_m)
    detected = energy > threshold
    return points[detected], energy[detected]


def record(columns_of, *, sweeps=3, name="drive.mcap", threshold=0.0, brightness=1.0, **fields):
    """Return a recording whose columns are computed from energies and ranges."""

    def read(number):
        points, energy = street(number, threshold, brightness)
        return Sweep(points, columns_of(energy, np.linalg.norm(points, axis=1)))

    return made_recording(name, sweeps, read, **fields)


def reflectances(energy, range_m):
    """Return reflectances multiplied by the cosine of the angle of incidence."""
    return energy / normal_incidence_energy(range_m)
