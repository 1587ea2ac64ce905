"""The page in words: its one sentence, its headline numbers, captions of the pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from poolpart.wording import counted

from .words import duration, excess, large, metres

Report = Mapping[str, Any]


@dataclass(frozen=True)
class Fact:
    """A number at the head of the page; `bad` where it should be another."""

    value: str
    what: str
    bad: bool = False


def summary(report: Report) -> str:
    """Say what was done and what came out."""
    objects = counted(report["parameters"]["objects"], "object")
    poses = counted(report["parameters"]["poses"], "position")
    text = (
        f"{counted(report['scans'], 'scan')} from {poses} sent {counted(report['rays'], 'ray')} at "
        f"{objects}; {report['hits']:,} hit, and {counted(report['points'], 'point')} of them "
        f"{'is' if report['points'] == 1 else 'are'} in the cloud"
    )
    return f"{text}{_path(report['planning'])}."


def _path(planning: Mapping[str, Any] | None) -> str:
    if planning is None:
        return ""
    trials = f"{counted(planning['trials'], 'particle swarm')} searched for a path meanwhile"
    if not planning["collision_free"]:
        return f"; {trials}, and found none that is free of collisions"
    text = f"; {trials}: the best is {metres(planning['best_length'])} long"
    if planning["excess"] is None:
        return text
    return f"{text}, {excess(planning['excess']).removeprefix('+')} above the shortest possible"


def facts(report: Report) -> list[Fact]:
    """Numbers for the head of the page."""
    seconds, wrong = report["seconds"], report["placement_violations"]
    found = [
        Fact(large(report["points"]), "points in the cloud"),
        Fact(large(report["rays"]), f"rays, cast by {report['backend']}"),
    ]
    if report["stages"]:
        found.append(Fact(duration(seconds["survey"]), "for the survey"))
        if report["planning"] is not None:
            found.append(Fact(duration(seconds["planning"]), "for the planning"))
            beside = seconds["survey_and_planning_overlap"]
            found.append(Fact(duration(beside), "both at work at the same time"))
    found.append(Fact(f"{wrong:,}", "tasks outside their partition", bad=wrong > 0))
    return found


def pictures(report: Report) -> dict[str, tuple[str, str]]:
    """{file: (what is to be seen, for those who cannot; caption)} of the pictures there are."""
    parameters = report["parameters"]
    objects = counted(parameters["objects"], "object")
    poses = counted(parameters["poses"], "sensor position")
    shown = {
        "scene.png": (
            f"Rendered scene of {objects}, with {poses} marked by red dots",
            f"The scene: {objects} of {counted(parameters['triangles'], 'triangle')}, {poses}.",
        ),
        "intensity.png": (
            "The same scene coloured by hits per square metre, with sample rays in red",
            f"Where the {counted(report['hits'], 'hit')} fell, per square metre, and some rays.",
        ),
        "cloud.png": (
            "Point cloud of the scene, coloured by object or height, from the same viewpoint",
            f"The cloud: {counted(report['points'], 'point')}, {_kept(parameters['keep_every'])}, "
            f"rounded to {parameters['precision_m']:g} m.",
        ),
        "path.png": (
            "Plan of the obstacles as discs, with the paths of all trials and the best one",
            "The planned path, seen from above, among those of the trials.",
        ),
    }
    return {name: said for name, said in shown.items() if name in report["files"]}


def _kept(every: int) -> str:
    return "one for each hit" if every == 1 else f"one for every {every:,} hits of a scan"
