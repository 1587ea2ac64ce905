"""The command `lidarpool sensors`: lists models, and draws their beams."""

from __future__ import annotations

from pathlib import Path

import click


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
        rows = [heads, *map(_figures, model_names())]
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


def _figures(name: str) -> tuple[str, ...]:
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
