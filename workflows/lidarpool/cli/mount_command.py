"""The `lidarpool mount` command, which compares mounting positions of lidars on a vehicle."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import click

from lidarsim.words import plural, printable

from . import shared_options as options
from .first_step import print_first_step
from .shared_options import overwrite

if TYPE_CHECKING:
    from lidarscenario.mounting.study import MountRanking

    from ..connection.tls_files import TlsFiles

_SHOWN = 10  # candidates in the printed table


@click.command()
@click.argument("vehicle", metavar="VEHICLE.yaml", type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    help="Output folder (default: named after the vehicle file).",
)
@options.scheduler
@options.workers
@options.unfinished("ranking")
@overwrite
@options.as_json
def mount(
    vehicle: Path,
    *,
    out: Path | None,
    scheduler: str | None,
    files: TlsFiles,
    workers: int | None,
    resume: bool,
    restart: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Compare mounting positions of lidars on a vehicle.

    VEHICLE.yaml describes the body of the vehicle, the sensors with candidate mounts or ranges to
    search, and the targets that they must detect. All beams of each sensor are simulated with the
    vehicle. The candidates are ranked by the share of the targets that they detect and by the area
    around the vehicle that they do not see.

    The output is a report with pictures, the ranking as JSON, and a scenario of the best candidate.

    \b
    Examples:
      lidarpool mount vehicle.yaml
      lidarpool mount vehicle.yaml --out mounts --overwrite
      lidarpool mount vehicle.yaml --resume --scheduler tcp://127.0.0.1:8786
    """  # noqa: D301 - Click requires the character \b
    options.check_workers(workers, scheduler)
    options.check_unfinished(resume=resume, restart=restart)
    print_first_step("reading the vehicle", quiet=as_json)
    from lidarfiles.processes.freed_memory import keep_freed_memory
    from lidarscenario.mounting.study import figures_of
    from lidarscenario.mounting.study_files import (
        FIGURES_FILE,
        PAGE_FILE,
        SCENARIO_FILE,
        rank_mounts,
    )

    from ..run.cluster.connection import connect_client
    from .terminal import Terminal

    keep_freed_memory()
    terminal = Terminal(quiet=as_json)
    folder = Path(f"{vehicle.stem}-mounts") if out is None else out
    with nullcontext() if scheduler is None else connect_client(scheduler, files) as client:
        result = rank_mounts(
            vehicle,
            folder,
            client=client,
            workers=workers,
            resume=resume,
            restart=restart,
            overwrite=overwrite,
            status=terminal.status,
        )
    options.print_results(figures_of(result), _lines(result), as_json)
    if not as_json:
        names = ", ".join((PAGE_FILE, FIGURES_FILE, SCENARIO_FILE))
        click.echo(f"results in {click.format_filename(folder)}: {names}")
        click.echo(f"next: lidarpool run {shlex.quote(str(folder / SCENARIO_FILE))}")


def _lines(result: MountRanking) -> Iterator[str]:
    """Format a ranking as lines of text."""
    study = result.study
    height = study.rules.ranked_height_m
    yield (
        f"{plural(len(result.ranked), 'candidate')}, {plural(result.mounts, 'simulated mount')}, "
        f"{plural(len(study.placements), 'target')}, map of {result.best.map_m2:,.0f} m²"
    )
    names = [printable(one.candidate.name) for one in result.ranked[:_SHOWN]]
    width = max(9, *map(len, names))
    blind = f"blind at {height:g} m"
    yield f"{'candidate':<{width}}    score   detected   {blind:>15}   hidden by vehicle"
    for name, one, front in zip(
        names, result.ranked[:_SHOWN], result.on_front[:_SHOWN], strict=True
    ):
        yield (
            f"{name:<{width}} {one.score:8.3f} {one.detection_rate:10.1%}   "
            f"{one.blind_m2[height]:12,.1f} m² {one.hidden_m2[height]:16,.1f} m²"
            f"{'   *' if front else ''}"
        )
    if len(result.ranked) > _SHOWN:
        yield f"and {plural(len(result.ranked) - _SHOWN, 'further candidate')} in the report"
    if len(result.ranked) > 1:
        yield "* on the trade-off curve of detection and blind area"
    yield from _class_lines(result)
    yield from _mount_lines(result)
    yield from (f"note: {note}" for note in result.notes)


def _class_lines(result: MountRanking) -> Iterator[str]:
    """Format how well the best candidate detects each class as lines of text."""
    best = result.best
    targets = [t for t in result.study.placements.targets if best.detection[t.name] >= 0]
    width = max(5, *(len(printable(target.name)) for target in targets))
    yield (
        f"{'class':<{width}}   detected   by two sensors   mean points   "
        f"({printable(best.candidate.name)})"
    )
    for target in targets:
        name = target.name
        yield (
            f"{printable(name):<{width}} {best.detection[name]:10.1%} "
            f"{best.redundancy[name]:16.1%} {best.mean_points[name]:13,.1f}"
        )


def _mount_lines(result: MountRanking) -> Iterator[str]:
    """Format the mounts of the best candidate as lines of text."""
    mounts = result.best.candidate.mounts
    width = max(6, *(len(printable(name)) for name in mounts))
    head = "".join(f"{word:>9}" for word in ("x", "y", "z", "yaw", "pitch", "roll"))
    yield f"{'sensor':<{width}}{head}   (m, degrees)"
    for name, pose in mounts.items():
        position = "".join(f"{value:9.3f}" for value in pose.position)
        angles = "".join(f"{v:9.1f}" for v in (pose.yaw_deg, pose.pitch_deg, pose.roll_deg))
        yield f"{printable(name):<{width}}{position}{angles}"
