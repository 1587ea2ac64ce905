"""The commands `lidarpool sensors`, and `stations`, which plans where to put a scanner."""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..base.errors import LidarpoolError
from ..base.words import counted
from . import options

if TYPE_CHECKING:
    from ..plan.stations import StationPlan
    from ..scenario.scenario import Scenario

SCENARIO_FILE, PICTURE_FILE = "stations.yaml", "stations.png"
_OBJECTS_TOLD = 12


@click.command()
@click.argument("model", required=False, metavar="[MODEL|FILE.yaml]")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="FILE.png",
    help="File for the picture.  [default: named after the model]",
)
def sensors(model: str | None, out: Path | None) -> None:
    """List sensor models, or draw the beams of one.

    \b
    Examples:
      lidarpool sensors
      lidarpool sensors velodyne/vlp16 --out vlp16.png
    """  # noqa: D301 - click wants the character, not its name
    from ..sensor.models import datasheet, load_sensor, model_names, read_model, shown_noise

    if model is None:
        heads = ("model", "channels", "field of view", "range", "turns a second", "points a second")
        rows = [heads, *map(_row, model_names())]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        for row in rows:
            click.echo("  ".join(map(str.ljust, row, widths)).rstrip())
        return
    described = read_model(model)
    from ..render.beam_picture import draw_beams  # imports Matplotlib, which lists do not need

    target = out or Path("-".join(Path(model).with_suffix("").parts[-2:]) + ".png")
    if target.suffix.lower() != ".png":
        raise click.UsageError(f"{target} is not a picture: give a name that ends in .png.")
    click.echo(described.name)
    for figure, source in described.sources.items():
        click.echo(f"{figure:<11}  {source}")
    if described.performance is not None:
        sheet = datasheet(model)
        click.echo(f"{'noise':<11}  {shown_noise(sheet.noise)}")
        returns = f"mode: {sheet.returns.mode}, subrays: {sheet.returns.subrays}"
        click.echo(f"{'returns':<11}  {returns}")
        if sheet.missing:
            click.echo(f"{'unknown':<11}  {', '.join(sheet.missing)}")
    draw_beams(target, load_sensor(model))
    click.echo(click.format_filename(target))


def _row(name: str) -> tuple[str, ...]:
    """Name of a model, channels, field of view, range, rates, points a second."""
    import numpy as np

    from ..sensor.models import load_sensor, read_model

    model = read_model(name)
    low, high = model.range_m or (0.0, float("inf"))
    rates = dict.fromkeys(model.rates_hz or (model.rate_hz,))
    firings, rate = model.turn(None, None)
    beams = model.beams
    channels = len(beams.elevation_deg) or len(beams.time_us) or 1
    if model.needs_calibration:
        view = "by the unit's file"
    elif model.mirror:
        view = f"{model.mirror.width_deg:g}° across, below"
    elif model.prisms:
        ahead = load_sensor(name).directions(np.arange(20_000))[..., 0].min()
        view = f"{2 * np.degrees(np.arccos(ahead)):.1f}° circle ahead"
    else:
        view = f"360° x {min(beams.elevation_deg):.1f}° to {max(beams.elevation_deg):.1f}°"
    turns, points = " to ".join(f"{one:g}" for one in rates), f"{firings * rate * channels:,.0f}"
    return name, f"{channels:,}", view, f"{low:g} to {high:g} m", turns, points


def _share(text: str) -> float:
    """Parse a percentage such as 95% or 95."""
    try:
        share = float(text.removesuffix("%")) / 100
    except ValueError:
        share = math.nan
    if not (0.01 <= share <= 1):
        raise click.BadParameter(f"{text!r} is not 1% to 100%: give a percentage, such as 95%.")
    return share


@click.command(context_settings={"show_default": True})
@click.argument("scene", metavar="MESH|SCENARIO", type=click.Path(path_type=Path))
@click.option(
    "--sensor",
    "model",
    metavar="MODEL|FILE.yaml",
    required=True,
    help="The instrument: a model of lidarpool sensors, with or without its maker.",
)
@click.option("--count", type=click.IntRange(1, 100), help="Number of stations.")
@click.option(
    "--coverage",
    type=_share,
    metavar="SHARE",
    help="Choose until this share of what can be seen is covered, such as 95%; without --count "
    "and --coverage, for as long as each station adds 1%.",
)
@click.option("--height", default=1.7, metavar="M", help="Of the instrument above the floor.")
@click.option(
    "--spacing",
    type=float,
    metavar="M",
    help="Between the places that are tried.  [default: for about 600 places]",
)
@click.option("--slant", default=80.0, metavar="DEG", help="Largest angle of incidence.")
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    help="Folder for stations.yaml and stations.png.  [default: named after the scene]",
)
@options.overwrite
@options.as_json
def stations(
    scene: Path,
    model: str,
    count: int | None,
    coverage: float | None,
    height: float,
    spacing: float | None,
    slant: float,
    out: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Choose stations for a terrestrial scan.

    Places on the floor are tried, and whichever adds most to what is covered comes next. Coverage
    is by area, of what any of these places sees. A scenario with the stations is written, and a
    picture of what they cover.

    \b
    Examples:
      lidarpool stations hall.glb --sensor riegl-vz400 --coverage 95%
      lidarpool stations hall/scenario.yaml --sensor riegl-vz400 --count 6 --out hall/stations
    """  # noqa: D301 - click wants the character, not its name
    if count is not None and coverage is not None:
        raise click.UsageError("--count and --coverage both say when to stop: give one of them.")
    from ..plan.stations import STATIONS_MOST, plan_stations
    from ..report.pictures import draw_stations
    from ..scenario.advice import advice
    from ..scenario.build import build
    from ..scenario.scenario import Scenario
    from ..sensor.models import full_name, load_sensor
    from .terminal import Terminal

    folder = Path(f"{scene.stem}-stations") if out is None else out
    there = [folder / name for name in (SCENARIO_FILE, PICTURE_FILE) if (folder / name).exists()]
    if there and not overwrite:
        raise LidarpoolError(f"{there[0]} exists: give another folder, --out, or --overwrite.")
    model = full_name(model)
    sensor = load_sensor(model)
    read, terminal = Scenario.load(scene), Terminal(quiet=as_json)
    with terminal.status("reading the scene", logged=False):
        built = build(read, plans=False)
    with terminal.status("looking from all places", logged=False):
        plan = plan_stations(
            built.scene, sensor, count=count, coverage=coverage,
            height_m=height, spacing_m=spacing, slant_deg=slant,
        )  # fmt: skip
    with terminal.status("drawing the picture", logged=False):
        page = draw_stations(built.scene, plan)
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / SCENARIO_FILE
    file.write_text(_scenario(read, scene.parent, folder, model, plan), "utf-8", newline="\n")
    page.save(folder / PICTURE_FILE)
    notes = advice(built)
    reached = float(plan.coverage[-1])
    if coverage is not None and reached < coverage:
        notes.append(
            f"{coverage:.0%} is not reached: {STATIONS_MOST} stations, which is the most, cover "
            f"{reached:.1%}; try a greater --height, --slant or --spacing"
        )
    if count is not None and len(plan.stations) < count:
        notes.append(f"{len(plan.stations)} of {count} stations already see all that can be seen")
    figures = _figures(plan, built.scene.names, sensor.model, notes)
    lines = [*_told(plan, built.scene.names), *(f"note: {note}" for note in notes)]
    options.show(figures, lines, as_json)
    if not as_json:
        click.echo(f"stations in {click.format_filename(folder)}: {SCENARIO_FILE}, {PICTURE_FILE}")
        click.echo(f"next: lidarpool check {shlex.quote(str(file))}")


def _scenario(read: Scenario, base: Path, folder: Path, model: str, plan: StationPlan) -> str:
    """Return the text of a scenario whose poses are the stations."""
    import yaml

    from ..scenario.scenario import MESH_CLOUD

    def moved(file: str) -> str:
        path = (base / Path(file).expanduser()).resolve()
        return Path(os.path.relpath(path, folder.resolve())).as_posix()

    entry = read.scene.model_dump(exclude_unset=True, mode="json", by_alias=True)
    copies = entry.get("copies", [])
    named = [*entry.get("files", []), *(c.get(kind) for c in copies for kind in ("file", "table"))]
    for one in filter(None, named):
        one["file"] = moved(one["file"])
    if model.endswith((".yaml", ".yml")):
        model = Path(os.path.relpath(Path(model).resolve(), folder.resolve())).as_posix()
    data = {
        **({"scene": entry} if entry else {}),
        "sensor": {"model": model},
        "poses": [[round(float(part), 3) for part in place] for place in plan.stations],
        "steps": 36,
        "cloud": {**MESH_CLOUD, "columns": ["range"]},
    }
    head = (
        f"# {counted(len(plan.stations), 'station')}, in the order in which they were chosen: "
        f"{plan.coverage[-1]:.1%} of what\n# can be seen is covered. Steps are of 10 degrees: one "
        "turn from each.\n"
    )
    return head + yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)


def _figures(
    plan: StationPlan, names: tuple[str, ...], sensor: str, notes: list[str]
) -> dict[str, Any]:
    """Return what --json prints."""
    return {
        "sensor": sensor,
        "places": len(plan.candidates),
        "spacing_m": plan.spacing_m,
        "stations": [
            {"position": [round(float(part), 3) for part in place], "coverage": float(share)}
            for place, share in zip(plan.stations, plan.coverage, strict=True)
        ],
        "objects": {
            name: {"visible_m2": float(visible), "covered_m2": float(covered)}
            for name, visible, covered in zip(names, plan.visible_m2, plan.covered_m2, strict=True)
        },
        "notes": notes,
    }


def _told(plan: StationPlan, names: tuple[str, ...]) -> Iterator[str]:
    """Print a plan as lines of text: stations, then objects, those with most left first."""
    from ..render.page import without_common_prefix

    yield (
        f"{counted(len(plan.candidates), 'place')} on a grid of {plan.spacing_m:g} m, which see "
        f"{plan.visible_m2.sum():,.0f} m²"
    )
    yield "station        x          y          z   covered     added"
    before = 0.0
    rows = zip(plan.stations.tolist(), plan.coverage.tolist(), strict=True)
    for number, ((x, y, z), share) in enumerate(rows, 1):
        yield f"{number:7} {x:10,.2f} {y:10,.2f} {z:10,.2f} {share:9.1%} {share - before:9.1%}"
        before = share
    left = plan.visible_m2 - plan.covered_m2
    order = [k for k in (-left).argsort(kind="stable").tolist() if plan.visible_m2[k] > 0]
    shown = order[:_OBJECTS_TOLD]
    labels = without_common_prefix(names)
    groups = [(labels[k], [k]) for k in shown]
    if others := order[_OBJECTS_TOLD:]:
        groups.append((f"{len(others):,} others", others))
    wide = max(6, *(len(label) for label, _ in groups))
    yield f"{'object':<{wide}}  can be seen   covered"
    for label, those in groups:
        visible, covered = plan.visible_m2[those].sum(), plan.covered_m2[those].sum()
        yield f"{label:<{wide}} {visible:9,.1f} m² {covered / visible:9.1%}"
    blind = len(names) - len(order)
    if blind:
        yield f"out of sight from all places: {counted(blind, 'object')}"
