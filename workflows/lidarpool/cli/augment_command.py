"""The `lidarpool augment` command, which simulates effects on recorded sweeps."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from lidarsim.errors import LidarError
from lidarsim.schema.vocabulary import INSERTIONS, RETURN_MODES

from . import completion
from . import shared_options as options
from .first_step import print_first_step
from .shared_options import overwrite

if TYPE_CHECKING:
    from lidarreal.augmentation.effects import Insertion
    from lidarreal.augmentation.variants import Variants

    from ..connection.tls_files import TlsFiles

_PACKET_FIRINGS = 16  # firings per packet of --dropped-packets
_INSERTION_OPTIONS = ("insert", "at", "heading", "class_name", "object_name")
_SPELLINGS = {"class_name": "--class", "object_name": "--name"}
_ORDER = "lidarpool.augment.order"  # key of the order of options in the context


def _parse_point(text: str) -> tuple[float, ...]:
    """Parse a position in the form x,y or x,y,z."""
    try:
        numbers = tuple(map(float, text.split(",")))
    except ValueError:
        numbers = ()
    if len(numbers) not in (2, 3):
        raise click.BadParameter(
            f"{text!r} is not a position. Expected X,Y or X,Y,Z in meters, for example 12,3."
        )
    return numbers


def _parse_channels(text: str) -> list[int]:
    """Parse a list of channels in the form 3,7."""
    try:
        return [int(number) for number in text.split(",")]
    except ValueError as error:
        message = f"{text!r} is not a list of channels. Expected whole numbers, for example 3,7."
        raise click.BadParameter(message) from error


def _parse_range(text: str) -> range:
    """Parse a range of sweeps in the form FIRST:LAST, or the number of a sweep."""
    first, colon, last = text.partition(":")
    try:
        start = int(first or 0)
        stop = (int(last) if last else _MAX_SWEEPS) if colon else start + 1
    except ValueError:
        start = stop = -1
    if not 0 <= start < stop:
        raise click.BadParameter(
            f"{text!r} is not a range of sweeps. Expected FIRST:END, for example 0:100 for the "
            "first 100 sweeps."
        )
    return range(start, stop)


_MAX_SWEEPS = 1 << 31  # end of a range without an end


class _InsertionCommand(click.Command):
    """Command in which options such as --at belong to the preceding --insert."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments, and store the order of the options in the context."""
        if not ctx.resilient_parsing:
            parser = self.make_parser(ctx)
            _, _, order = parser.parse_args(args=[*args])
            ctx.meta[_ORDER] = [parameter.name for parameter in order]
        return super().parse_args(ctx, args)


class _Placement(NamedTuple):
    """Options of an inserted object."""

    shape: str
    at: tuple[float, ...]
    heading_deg: float
    class_name: str
    name: str


@click.command(cls=_InsertionCommand)
@click.argument("recording", metavar="RECORDING", type=click.Path(path_type=Path))
@click.argument(
    "effects", metavar="[EFFECTS|CAMPAIGN]", required=False, type=click.Path(path_type=Path)
)
@click.option(
    "--out",
    "-o",
    type=options.StoragePath(),
    metavar="PATH",
    required=True,
    help="Output file or folder.",
)
@click.option(
    "--format",
    "output_format",
    metavar="FORMAT",
    shell_complete=completion.format_name,
    help="Output format (default: the format of the recording).",
)
@click.option(
    "--model",
    metavar="MODEL|FILE",
    shell_complete=completion.sensors,
    help="Model of the recorded sensor, which defines the intensity scale, optics and "
    "sensitivity (default: estimated from the recording).",
)
@click.option(
    "--topic",
    metavar="NAME",
    help="Augment only this sensor, topic or sequence of the recording (default: all).",
)
@click.option("--intensity", metavar="COLUMN", help="Column that contains the intensity.")
@click.option(
    "--reflectance",
    type=options.Number(0, 1, min_open=True),
    metavar="SHARE",
    help="Reflectance of all recorded surfaces, for a recording without intensities.",
)
@click.option("--rain", type=options.Number(0, 300), metavar="MM_H", help="Rain rate in mm/h.")
@click.option(
    "--snow",
    type=options.Number(0, 50),
    metavar="MM_H",
    help="Snowfall rate in mm/h (water equivalent).",
)
@click.option(
    "--fog",
    type=options.Number(0.001, 1e6),
    metavar="KM",
    help="Visibility in fog or haze in kilometers.",
)
@click.option(
    "--dust",
    type=options.Number(0, 1e5),
    metavar="MG_M3",
    help="Concentration of mineral dust in mg/m³.",
)
@click.option(
    "--dirt",
    type=options.Number(0, 1),
    metavar="SHARE",
    help="Share of the energy that dirt on the window transmits, out and back combined.",
)
@click.option(
    "--dead-channels",
    type=_parse_channels,
    metavar="N,…",
    help="Channels without returns; 0 is the lowest channel.",
)
@click.option(
    "--dropped-packets",
    type=options.Number(0, 1),
    metavar="SHARE",
    help=f"Share of packets that are lost. A packet contains {_PACKET_FIRINGS} firings.",
)
@click.option(
    "--dropout",
    type=options.Number(0, 1),
    metavar="SHARE",
    help="Share of returns that are lost at random.",
)
@click.option(
    "--range-noise",
    type=options.Number(0, 1000),
    metavar="M",
    help="Standard deviation of the noise added to ranges, in meters.",
)
@click.option(
    "--mode",
    type=click.Choice(RETURN_MODES),
    help="Returns that are reported per pulse (default: as in the recording).",
)
@click.option(
    "--insert",
    metavar="SHAPE",
    multiple=True,
    shell_complete=completion.insertions,
    help="Insert a car, a pedestrian or a mesh file. Can be repeated. The options --at, --heading, "
    "--class and --name that follow apply to this object.",
)
@click.option(
    "--at",
    type=_parse_point,
    metavar="X,Y[,Z]",
    multiple=True,
    help="Position of the inserted object in the sensor frame of the first sweep, in meters "
    "(default of Z: on the ground).",
)
@click.option(
    "--heading",
    type=options.Number(),
    metavar="DEG",
    multiple=True,
    help="Heading of the inserted object in degrees, counterclockwise from the x axis of the "
    "sensor (default: 0).",
)
@click.option(
    "--class",
    "class_name",
    metavar="NAME",
    multiple=True,
    help="Class of the inserted object (default: car or pedestrian for these shapes).",
)
@click.option(
    "--name",
    "object_name",
    metavar="NAME",
    multiple=True,
    help="Name of the inserted object (default: its shape or file, with a number if it is "
    "repeated).",
)
@click.option(
    "--sensor",
    metavar="MODEL|FILE",
    shell_complete=completion.sensors,
    help="Resample the sweeps to another sensor. Its field of view and resolution must not exceed "
    "those of the recorded sensor.",
)
@options.flag(
    "--partial", help="Omit pulses of --sensor that the recorded sensor does not observe."
)
@click.option("--seed", type=click.IntRange(0), metavar="N", help="Random seed (default: 0).")
@click.option(
    "--sweeps",
    type=_parse_range,
    metavar="FIRST:END",
    help="Augment only these sweeps, for example 0:100, and keep the others unchanged.",
)
@options.scheduler
@options.workers
@options.flag("--resume", help="Resume an unfinished augmentation, if there is one.")
@options.flag("--restart", help="Discard an unfinished augmentation and start again.")
@overwrite
@options.flag("--quiet", "-q", help="Do not show progress.")
@options.as_json
def augment(
    recording: Path,
    effects: Path | None,
    out: Any,
    *,
    model: str | None,
    topic: str | None,
    intensity: str | None,
    reflectance: float | None,
    output_format: str | None,
    sensor: str | None,
    partial: bool,
    sweeps: range | None,
    scheduler: str | None,
    files: TlsFiles,
    workers: int | None,
    resume: bool,
    restart: bool,
    overwrite: bool,
    quiet: bool,
    as_json: bool,
    **settings: Any,
) -> None:
    """Simulate weather, faults and noise on recorded sweeps, and insert objects.

    The augmented copy has the format of the recording. EFFECTS is a file with the sections weather,
    noise, faults, returns (mode only), actors, traffic, materials and classes of a scenario, and
    options override its fields. Actors are placed in the world frame of the recording. For a
    campaign file, whose base is an effects file, a copy is written for each variant.

    \b
    Examples:
      lidarpool augment drive.mcap --out wet --rain 25
      lidarpool augment kitti effects.yaml --out kitti-foggy
      lidarpool augment drive.mcap --out cars --insert car --at 12,3 --heading 90
      lidarpool augment nuscenes campaign.yaml --out variants --scheduler tcp://127.0.0.1:8786
      lidarpool augment pandar128.mcap --out vlp16 --sensor velodyne/vlp16
    """  # noqa: D301 - Click requires the character \b
    if resume and restart:
        raise click.UsageError("`--resume` and `--restart` cannot be combined.")
    options.check_workers(workers, scheduler)
    if partial and sensor is None:
        raise click.UsageError("`--partial` requires `--sensor`.")
    if not isinstance(out, Path):
        raise LidarError(
            f"{out} is a URL, but files are linked to the recording. Specify a local path with "
            "`--out`, and copy the result afterwards."
        )
    placements = _placements(settings)
    print_first_step("reading the recording", quiet=quiet)
    from lidarfiles.clouds.recording_ref import RecordingRef
    from lidarfiles.processes.freed_memory import keep_freed_memory
    from lidarreal.augmentation.running import Augmentation

    from ..run.cluster.connection import connect_client
    from .terminal import Terminal

    keep_freed_memory()
    terminal = Terminal(quiet, False, as_json)
    augmentation = Augmentation(
        RecordingRef(recording, topic, intensity),
        _variants(effects, placements, terminal, settings, allow_empty=sensor is not None),
        None if model is None else _load_model(model),
        sweeps,
        output_format,
        None if sensor is None else _load_model(sensor),
        reflectance,
        partial,
    )
    client = nullcontext() if scheduler is None else connect_client(scheduler, files)
    with client as connected, terminal.writing("augmenting the sweeps") as show:
        augmented = augmentation.run(
            out,
            client=connected,
            workers=workers,
            resume=resume,
            restart=restart,
            overwrite=overwrite,
            progress=lambda done, total: show("augment", done, total, "sweeps"),
        )
    first = shlex.quote(str(augmented.outputs[0]))
    lines = [*terminal.notes(augmented.notes), repr(augmented)]
    lines.append(f"{'variants' if augmented.table else 'result'} in {click.format_filename(out)}")
    lines.append(f"next: lidarpool view {first}")
    options.print_results(augmented.figures, lines, as_json)


def _load_model(name: str) -> Any:
    """Load a sensor model with the values of its data sheet, if it has any."""
    from lidarsim.sensor.models import load_sensor, read_model

    model = read_model(name)
    return load_sensor(name, performance="ideal" if model.performance is None else "datasheet")


def _variants(
    path: Path | None,
    placements: Sequence[_Placement],
    terminal: Any,
    settings: dict[str, Any],
    *,
    allow_empty: bool,
) -> Variants:
    """Return the variants of effects in a file, with the effects of options."""
    from lidarreal.augmentation.effects import Effects
    from lidarreal.augmentation.variants import CampaignVariants, Variants
    from lidarscenario.campaign.campaign_file import is_campaign

    sections = _sections(settings)
    seed = settings["seed"]
    insertions = tuple(_load_insertion(placement, terminal) for placement in placements)
    if path is not None and is_campaign(path):
        for name in (*sections, *(["seed"] if seed is not None else [])):
            raise click.UsageError(
                f"Options for `{name}` cannot be combined with a campaign. Set `{name}` in "
                f"{'the base of ' * (name != 'seed')}{path}."
            )
        return CampaignVariants(path, insertions)
    effects = Effects.load(path, sections)
    effects = replace(effects, insertions=insertions)
    if seed is not None:
        effects = replace(effects, seed=seed)
    if effects.is_empty and not allow_empty:
        reason = "No effects are specified" if path is None else f"{path} has no effects"
        raise LidarError(
            f"{reason}. Pass an effects file, or an option such as `--rain 25` or `--insert car`."
        )
    return Variants(effects)


def _sections(settings: dict[str, Any]) -> dict[str, Any]:
    """Return the sections of a scenario that options set."""

    def chosen(names: dict[str, str]) -> dict[str, Any]:
        return {
            field: settings[option]
            for option, field in names.items()
            if settings[option] is not None
        }

    weather = {
        "rain": "rain_mm_h",
        "snow": "snow_mm_h",
        "fog": "visibility_km",
        "dust": "dust_mg_m3",
    }
    faults: list[dict[str, Any]] = []
    if settings["dirt"] is not None:
        faults.append({"kind": "dirt", "transmission": settings["dirt"]})
    if settings["dead_channels"] is not None:
        faults.append({"kind": "dead_channels", "channels": settings["dead_channels"]})
    if (share := settings["dropped_packets"]) is not None:
        faults.append({"kind": "dropped_packets", "share": share, "packet": _PACKET_FIRINGS})
    sections = {
        "weather": chosen(weather),
        "noise": chosen({"dropout": "dropout", "range_noise": "range_m"}),
        "returns": chosen({"mode": "mode"}),
        "faults": faults,
    }
    return {name: content for name, content in sections.items() if content}


def _placements(settings: dict[str, Any]) -> list[_Placement]:
    """Return the inserted objects, whose options follow each --insert."""
    values = {name: iter(settings.pop(name)) for name in _INSERTION_OPTIONS}
    objects: list[dict[str, Any]] = []
    for name in click.get_current_context().meta[_ORDER]:
        if name == "insert":
            objects.append({"insert": next(values["insert"])})
        elif name in values:
            option = _SPELLINGS.get(name, f"--{name}")
            if not objects:
                raise click.UsageError(
                    f"`{option}` must follow the `--insert` of the object to which it belongs."
                )
            if name in objects[-1]:
                raise click.UsageError(
                    f"`{option}` occurs twice for `--insert {objects[-1]['insert']}`. Repeat "
                    "`--insert` for each object."
                )
            objects[-1][name] = next(values[name])
    for entry in objects:
        if "at" not in entry:
            raise click.UsageError(
                f"`--insert {entry['insert']}` requires a position. Add `--at X,Y` after it."
            )
    return [
        _Placement(
            entry["insert"],
            entry["at"],
            entry.get("heading", 0.0),
            entry.get("class_name", ""),
            entry.get("object_name", ""),
        )
        for entry in objects
    ]


def _load_insertion(placement: _Placement, terminal: Any) -> Insertion:
    from lidarreal.augmentation.effects import Insertion
    from lidarreal.augmentation.insertions import load_insertion

    mesh = load_insertion(placement.shape, terminal.report)
    kind = placement.class_name or (placement.shape if placement.shape in INSERTIONS else "")
    x, y, z = (*placement.at, None)[:3]
    assert x is not None
    assert y is not None
    return Insertion(mesh, x, y, z, placement.heading_deg, kind, placement.name)
