"""Draws the pictures of docs/effects.md, and measures what each effect costs.

Each module beside this one has `DRAWS`, the name of its picture, `picture(path)`, which draws it,
and `on(survey)`, the same survey with the effect, and maybe `of(scene)`, which adds what moves
with and without it. The survey stands in a street; the time of stage
2 with the effect is compared with the time without, in turns.

    python -m benchmarks.effects [--only rain] [--pictures docs/images] [--json out.json]
"""

from __future__ import annotations

import argparse
import json
import pkgutil
import statistics
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from benchmarks import effects
from lidarpool import Survey, load_sensor
from lidarscenes.procedural.city import city
from lidarsim.simulator.batch import columns_of
from lidarsim.simulator.rig import Rig

ROUNDS, SCANS = 5, 36


def modules(only: Sequence[str] = ()) -> dict[str, ModuleType]:
    """Modules of effects by name."""
    names = [found.name for found in pkgutil.iter_modules(effects.__path__)]
    return {
        name: import_module(f"{effects.__name__}.{name}")
        for name in names
        if not name.startswith("_") and (not only or name in only)
    }


def survey_without() -> Survey:
    """Return a turn of an OS1-64 in a street, every return kept, with intensities."""
    sensor = load_sensor("ouster/os1-64", max_range_m=120)
    return Survey(sensor, poses=[(0, 0, 2)], steps=SCANS, columns=["intensity", "range"])


def seconds(rig: Rig, scans: int) -> float:
    """Processor time of casting so many scans and making their columns."""
    begin = time.process_time()
    columns_of(list(rig.cast(0, scans)))
    return time.process_time() - begin


def costs(found: dict[str, ModuleType], rounds: int = ROUNDS) -> dict[str, float]:
    """Time of stage 2 with each effect, relative to that without: the median of some rounds."""
    scene, without = city(20_000), survey_without()
    plain, rigs = Rig(scene, without), {}
    for name, module in found.items():
        moving = module.of(scene) if hasattr(module, "of") else None
        bare = plain if moving is None else Rig(moving, without)
        rigs[name] = Rig(moving or scene, module.on(without)), bare
    ratios: dict[str, list[float]] = {name: [] for name in rigs}
    for number in range(rounds + 1):
        for name, (rig, bare) in rigs.items():
            ratio = seconds(rig, rig.survey.scan_count) / seconds(bare, without.scan_count)
            if number:  # the first compiles and fills caches
                ratios[name].append(ratio)
    return {name: statistics.median(some) for name, some in ratios.items()}


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Draw pictures and print the table of costs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[], help="names of effects")
    parser.add_argument("--pictures", type=Path, help="folder for the pictures")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="0 measures nothing")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    found = modules(options.only)
    if options.pictures:
        for module in found.values():
            module.picture(options.pictures / module.DRAWS)
    figures = costs(found, options.rounds) if options.rounds else {}
    for name, ratio in figures.items():
        print(f"{name:<16} {ratio:6.2f}")
    if options.json:
        options.json.write_text(json.dumps(figures))
    return figures


if __name__ == "__main__":
    main()
