"""Measure how well moving objects of a recording are reconstructed as actors.

A drive through a city among three moving cars, of which one is parked at first, is recorded with a
simulated sensor without noise. Its twin is reconstructed with the boxes of the cars and without
them, and every second sweep is held out. The boxes of the cars are known, so the points in them are
measured in both cases.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import numpy as np
from tests.city_drives import CARS, car_drive, car_position

from lidarpool import twin

_STEP_S = 0.1


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a table row for each source of the moving objects."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensor", default="ouster/os1-32")
    parser.add_argument("--columns", type=int, default=512)
    parser.add_argument("--sweeps", type=int, default=24)
    parser.add_argument("--noise", action="store_true", help="noise of the data sheet")
    options = parser.parse_args(arguments)
    settings = {"columns": options.columns}
    if options.noise:
        settings["performance"] = "datasheet"
    drive = car_drive(options.sensor, settings, options.sweeps)
    print("| source | rays | half within | 90 % within | no surface | ghosts | remains |")
    print("|---|--:|--:|--:|--:|--:|--:|")
    for source in ("boxes", "clusters"):
        found = twin(drive, actors=source)
        moving = found.figures["held_out"]["moving"]
        middles = found.scene.vertices[found.scene.faces].mean(axis=1)
        remains = sum(
            int(_on_car(middles - car_position(car, time_s)).sum())
            for car in range(len(CARS))
            for time_s in np.arange(0, _STEP_S * options.sweeps, _STEP_S).tolist()
        )
        print(
            f"| {source} | {moving['rays']:,} "
            f"| {1000 * moving['median_abs_difference_m']:.1f} mm "
            f"| {1000 * moving['p90_abs_difference_m']:.0f} mm "
            f"| {100 * moving['no_surface']:.2f} % | {100 * moving['ghosts']:.2f} % "
            f"({100 * moving['ghosts_on_objects']:.1f} % of those on objects) | {remains} |",
            flush=True,
        )
    return 0


def _on_car(offsets: np.ndarray) -> np.ndarray:
    """Mark positions relative to a car that are inside its body."""
    return (np.abs(offsets - (0, 0, 0.75)) < (1.8, 0.6, 0.55)).all(axis=1)


if __name__ == "__main__":
    sys.exit(main())
