"""What each effect of docs/effects.md costs: `python -m benchmarks.effects [--only rain fog]`.

Stage 2 of a survey in a street, with the effect and without, in turns. Prints the median ratio of
processor times. The surveys are those of `docs/pictures/effects/`.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from docs.pictures.effects._catalog import load_effects
from docs.pictures.effects._street import survey_without

from lidarscenes.procedural.city import city
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig

ROUNDS = 5


def stage_seconds(rig: Rig) -> float:
    """Return the processor time of casting all scans and making their columns, seconds."""
    begin = time.process_time()
    columns_of(list(rig.cast(0, rig.survey.scan_count)))
    return time.process_time() - begin


def costs(
    effects: Mapping[str, Any], rounds: int = ROUNDS, triangles: int = 20_000
) -> dict[str, float]:
    """Return the median time of stage 2 with each effect, relative to the time without."""
    scene = city(triangles)
    plain_survey = survey_without()
    plain = Rig(scene, plain_survey)
    rigs = {}  # {effect: (with it, without it)}
    for name, effect in effects.items():
        moving_scene = effect.with_actors(scene) if hasattr(effect, "with_actors") else None
        bare = plain if moving_scene is None else Rig(moving_scene, plain_survey)
        rigs[name] = Rig(moving_scene or scene, effect.with_effect(plain_survey)), bare
    ratios: dict[str, list[float]] = {name: [] for name in rigs}
    for number in range(rounds + 1):
        for name, (rig, bare) in rigs.items():
            ratio = stage_seconds(rig) / stage_seconds(bare)
            if number:  # the first compiles and fills caches
                ratios[name].append(ratio)
    return {name: statistics.median(values) for name, values in ratios.items()}


def main(arguments: Sequence[str] | None = None) -> dict[str, float]:
    """Print the table of costs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[], help="names of effects")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--triangles", type=int, default=20_000, help="of the street")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    figures = costs(load_effects(options.only), options.rounds, options.triangles)
    for name, ratio in figures.items():
        print(f"{name:<16} {ratio:6.2f}")
    if options.json:
        options.json.write_text(json.dumps(figures))
    return figures


if __name__ == "__main__":
    main()
