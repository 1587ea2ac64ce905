"""Measure the casting time of each effect relative to the same survey without the effect.

    python -m benchmarks.effects [--only rain fog]

Casting a survey in a street and making its columns are measured with and without each effect, in
turn. The values are median ratios of CPU times. The surveys come from `docs/pictures/effects/`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from docs.pictures.effects._catalog import load_effects
from docs.pictures.effects._street import survey_without

from lidarscenes.procedural.city import city
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig

from .harness import argument_parser, median_ratio, run_rounds, time_call, write_results


def cast_survey(rig: Rig, _: int) -> float:
    """Measure the CPU time for casting all scans and making their columns, in seconds."""
    seconds, _part = time_call(lambda: columns_of(list(rig.cast(0, rig.survey.scan_count))))
    return seconds


def costs(effects: Mapping[str, Any], repeat: int, triangles: int) -> dict[str, float]:
    """Return the median time with each effect, relative to the time without it."""
    scene = city(triangles)
    plain_survey = survey_without()
    plain = Rig(scene, plain_survey)
    ratios = {}
    for name, effect in effects.items():
        moving_scene = effect.with_actors(scene) if hasattr(effect, "with_actors") else None
        bare = plain if moving_scene is None else Rig(moving_scene, plain_survey)
        rig = Rig(moving_scene or scene, effect.with_effect(plain_survey))
        sides = {"with": partial(cast_survey, rig), "without": partial(cast_survey, bare)}
        seconds = run_rounds(sides, repeat)
        ratios[name] = median_ratio(seconds["with"], seconds["without"])
    return ratios


def main(arguments: Sequence[str] | None = None) -> dict[str, float]:
    parser = argument_parser(__doc__, repeat=5)
    parser.add_argument("--only", nargs="*", default=[], help="measure only these effects")
    parser.add_argument("--triangles", type=int, default=20_000, help="triangles of the street")
    options = parser.parse_args(arguments)
    ratios = costs(load_effects(options.only), options.repeat, options.triangles)
    for name, ratio in ratios.items():
        print(f"{name:<16} {ratio:6.2f}")
    write_results(options.json, ratios)
    return ratios


if __name__ == "__main__":
    main()
