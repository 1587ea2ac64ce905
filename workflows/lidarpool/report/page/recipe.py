"""How to have a result once more: the command, and the scenario as text."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

import click
import yaml
from click.core import ParameterSource

from ...scenario.scenario import Scenario

POSES_MOST = 500  # written out; a survey may have a million
_ONCE = ("resume", "fresh", "quiet", "page")  # options that a repetition does not need


@dataclass(frozen=True)
class Recipe:
    """How to have a result once more.

    Parameters
    ----------
    name
        What the survey is called.
    command
        The command, for a shell; empty where it was not one.
    scenario
        The scenario as YAML, with what was left to defaults.
    remark
        What else is needed, such as where mesh files are looked for.
    """

    name: str
    command: str
    scenario: str
    remark: str = ""


def make_recipe(scenario: Scenario, context: click.Context | None) -> Recipe:
    """Write a recipe of a scenario, and of the command as it was called, if it was one."""
    source = context.params.get("scenario") if context else None
    remarks = []
    if scenario.scene.files:
        remarks.append("File names start from the folder that the scenario is in.")
    if scenario.poses is not None and len(scenario.poses) > POSES_MOST:
        remarks.append(
            f"Only the first {POSES_MOST:,} of its {len(scenario.poses):,} poses are written here."
        )
        scenario = scenario.model_copy(update={"poses": scenario.poses[:POSES_MOST]})
    return Recipe(
        name="the default survey" if source is None else Path(source).name,
        command=shlex.join(_words(context)) if context else "",
        scenario=_as_yaml(scenario),
        remark=" ".join(remarks),
    )


def _words(context: click.Context) -> list[str]:
    """Return the command with what was given to it."""
    words, named = context.command_path.split(), []
    for parameter in context.command.params:
        name, value = str(parameter.name), context.params.get(str(parameter.name))
        if context.get_parameter_source(name) is not ParameterSource.COMMANDLINE or name in _ONCE:
            continue
        if isinstance(parameter, click.Argument):
            words.append(str(value))
        else:
            flag = isinstance(parameter, click.Option) and parameter.is_flag
            named += [max(parameter.opts, key=len)] + [str(value)] * (not flag)
    return words + named


def _as_yaml(scenario: Scenario) -> str:
    """Return a scenario as YAML that can be loaded."""
    data = scenario.model_dump(mode="json", exclude_none=True)
    for entry in data["scene"]["files"]:
        if "matrix" in entry:  # says where a mesh stands; the other three would contradict it
            for name in ("translation", "rotation_deg", "scale"):
                entry.pop(name, None)
    return yaml.safe_dump(
        data, sort_keys=False, allow_unicode=True, default_flow_style=None, width=96
    )
