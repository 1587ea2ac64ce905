"""The command `lidarpool sensors`: models that there are, and pictures of their beams."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from poolpart.wording import counted

from ..sensor import LineSensor, Sensor
from ..sensor.models import load_sensor, model_names, read_model


@click.command()
@click.argument("model", required=False, metavar="[MODEL|FILE.yaml]")
@click.option(
    "--calibration",
    type=click.Path(path_type=Path),
    help="File of a unit of this model.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="FILE.png",
    help="Where the picture goes.  [default: named after the model]",
)
def sensors(model: str | None, calibration: Path | None, out: Path | None) -> None:
    """List the sensor models there are, or draw the beam pattern of one.

    \b
    Examples:
      lidarpool sensors
      lidarpool sensors velodyne/vlp16 --out vlp16.png
    """  # noqa: D301 - click wants the character, not its name
    if model is None and calibration is None:
        rows: list[tuple[str, ...]] = [
            ("model", "channels", "field of view", "range", "turns a second", "points a second")
        ]
        rows += [_row(name) for name in model_names()]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        for row in rows:
            cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
            click.echo("  ".join(cells).rstrip())
        return
    from ..render.beam_picture import draw_beams  # Matplotlib is a second without which lists do

    sensor = load_sensor(model, calibration=calibration)
    stem = "-".join(Path(model or calibration or "").with_suffix("").parts[-2:])
    target = out or Path(f"{stem}.png")
    if target.suffix.lower() != ".png":
        raise click.UsageError(f"{target} is no name of a picture: give one that ends in .png.")
    click.echo(f"{sensor.name}, {counted(sensor.channels, 'channel')}")
    if model is not None:
        for figure, source in read_model(model).sources.items():
            click.echo(f"{figure:<10}  {source}")
    draw_beams(target, sensor)
    click.echo(click.format_filename(target))


def _row(name: str) -> tuple[str, ...]:
    """Figures of a model: channels, field of view, range, rates, points a second."""
    model = read_model(name)
    low, high = model.range_m or (0.0, float("inf"))
    rates = model.rates_hz or (model.rate_hz, model.rate_hz)
    turns = f"{rates[0]:g}" if rates[0] == rates[1] else f"{rates[0]:g} to {rates[1]:g}"
    firings, rate = model.turn(None, None)
    channels, view = len(model.beams.time_us) or 1, "by the unit's file"
    if not model.needs_calibration:
        sensor = load_sensor(name)
        channels, view = sensor.channels, _field_of_view(sensor)
    points = f"{firings * rate * channels:,.0f}"
    return name, f"{channels:,}", view, f"{low:g} to {high:g} m", turns, points


def _field_of_view(sensor: Sensor) -> str:
    """Field of view: of a spinning head by its beams, else by where some rays go."""
    if sensor.channels > 1:
        low, high = np.degrees(sensor.beams.elevation[[0, -1]])
        return f"360° x {low:.1f}° to {high:.1f}°"
    x, y, z = sensor.directions(np.arange(20_000))[:, 0].T
    if isinstance(sensor, LineSensor):
        return f"{np.degrees(np.ptp(np.arctan2(y, -z))):.1f}° across, below"
    return f"{2 * np.degrees(np.arccos(x.min())):.1f}° circle ahead"
