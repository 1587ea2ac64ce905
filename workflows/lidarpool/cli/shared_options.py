"""Command-line options and output functions that several commands share."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial, reduce, wraps
from itertools import chain
from pathlib import Path
from typing import Any

import click

from lidarscenario.shard import Shard
from lidarsim.errors import LidarError, explain_os_errors
from lidarsim.schema.vocabulary import BACKENDS, UNITS_M

from ..connection.scheduler_address import (
    check_address,
    check_certificates,
    is_scheduler_file,
    read_scheduler_file,
)
from ..connection.tls_files import TlsFiles
from . import completion

Command = Callable[..., None]


class StoragePath(click.Path):
    """Parameter type for a local path or the URL of a remote storage."""

    def __init__(self, **options: Any) -> None:
        super().__init__(path_type=Path, **options)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Convert a local path to a Path, and a URL to a Storage."""
        from lidarsim.io.storage import Storage, is_url  # imported late to keep --help fast

        return Storage.at(value) if is_url(value) else super().convert(value, param, ctx)


class Number(click.FloatRange):
    """Parameter type for a finite number, optionally within a range."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Convert text to a number, and refuse NaN and infinity."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


flag = partial(click.option, is_flag=True)
path = partial(click.option, type=click.Path(path_type=Path), metavar="FILE")
new_file = partial(click.option, type=click.Path(dir_okay=False, path_type=Path), metavar="FILE")
out = click.option(
    "--out",
    type=StoragePath(),
    default=Path("lidarpool-out"),
    show_default=True,
    help="Output folder, created if necessary, or a URL such as s3://bucket/run.",
)
backend = click.option(
    "--backend",
    type=click.Choice(BACKENDS),
    help="Ray-casting backend (default: from the scenario, otherwise the fastest available).",
)
job = click.option(
    "--job", "number", type=click.IntRange(0), metavar="N", help="Run only job N of the campaign."
)
shard = click.option(
    "--shard",
    metavar="N/OF",
    type=Shard.parse,
    help="Run only shard N of OF, for example 3/10; combine the shards with lidarpool merge. Use "
    "auto in a Slurm job array, or auto/10 in an indexed Kubernetes Job with 10 pods.",
)
cluster = path(
    "--cluster",
    help="Start the Slurm, PBS or SSH cluster that FILE describes; see docs/how-to/queues.md.",
)
overwrite = flag("--overwrite", help="Overwrite existing files.")
as_json = flag("--json", "as_json", help="Print the results as JSON.")
WARNED = 1  # exit code of --strict
strict = flag("--strict", help="Exit with code 1 if there are warnings.")
result = click.argument("result", metavar="FOLDER", type=StoragePath())
copies = click.option(
    "--out", type=StoragePath(file_okay=False), help="Output folder (default: FOLDER)."
)


def combine(*options: Callable[[Command], Command]) -> Callable[[Command], Command]:
    """Return a decorator that adds options to a command in the given order."""
    return lambda command: reduce(
        lambda decorated, option: option(decorated), reversed(options), command
    )


def _parse_position(text: str) -> list[float]:
    """Parse a position in the form x,y,z.

    Whole numbers become integers, so that a scenario file shows them without a decimal point.
    """
    try:
        x, y, z = map(float, text.split(","))
    except ValueError as error:
        message = (
            f"{text!r} is not a position. Expected X,Y,Z, for example 0,0,1.9. To set angles, "
            "use a scenario file."
        )
        raise click.BadParameter(message) from error
    return [int(number) if number.is_integer() else number for number in (x, y, z)]


def _parse_names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")]


def _mesh_option(name: str, description: str, **settings: Any) -> Callable[[Command], Command]:
    """Return an option that applies only to mesh files."""
    return click.option(f"--{name}", help=f"{description}. Mesh input only.", **settings)


_mesh_list_option = partial(_mesh_option, metavar="NAME,…", type=_parse_names, multiple=True)
poses = click.option("--pose", metavar="X,Y,Z", type=_parse_position, multiple=True,
                     help="Position of the sensor in the scene, in meters; can be repeated, with "
                     "one position per sweep (default: from the recording, otherwise "
                     "0,0,0).")  # fmt: skip
_MESH_READING = ("unit", "up_axis")  # options of all commands that read meshes
_mesh_reading_options = combine(
    _mesh_option(
        "unit",
        "Length unit of the mesh (default: from the file, otherwise m)",
        type=click.Choice([*UNITS_M]),
    ),
    _mesh_option(
        "up-axis",
        "Up axis of the mesh (default: from the file, otherwise z)",
        type=click.Choice([*"xyz"]),
    ),
)
_mesh_options = combine(
    click.option(
        "--sensor",
        help="Sensor model, as listed by lidarpool sensors, or a sensor file. Mesh input, or "
        "scenarios with one sensor.",
        metavar="MODEL|FILE.yaml",
        shell_complete=completion.sensors,
    ),
    _mesh_reading_options,
    _mesh_list_option(
        "pose",
        "Position of the sensor in meters; can be repeated",
        metavar="X,Y,Z",
        type=_parse_position,
    ),
    _mesh_list_option(
        "columns",
        "Additional columns of the point cloud, such as range,intensity",
        shell_complete=completion.columns,
    ),
    _mesh_list_option(
        "format", "Additional output formats, such as las", shell_complete=completion.formats
    ),
)


def mesh_options(command: Command) -> Command:
    """Add the options for mesh files, and pass their values to the command as `of_mesh`.

    `of_mesh` is a dictionary that contains arguments of `mesh_data`.
    """

    @wraps(command)
    def with_options(
        *arguments: Any,
        pose: Any,
        columns: Any,
        format: Any,  # noqa: A002 - must match the name of the option
        **settings: Any,
    ) -> None:
        values = {name: settings.pop(name) for name in ("sensor", *_MESH_READING)}
        values |= {"pose": [*pose], "columns": [*chain(*columns)], "format": [*chain(*format)]}
        values = {name: value for name, value in values.items() if value not in (None, [])}
        command(*arguments, of_mesh=values, **settings)

    return _mesh_options(with_options)


def mesh_reading(command: Command) -> Command:
    """Add --unit and --up-axis, and pass their values to the command as `of_mesh`."""

    @wraps(command)
    def with_options(*arguments: Any, **settings: Any) -> None:
        values = {name: settings.pop(name) for name in _MESH_READING}
        values = {name: value for name, value in values.items() if value is not None}
        command(*arguments, of_mesh=values, **settings)

    return _mesh_reading_options(with_options)


def reject_mesh_options(of_mesh: Mapping[str, Any], path: Any) -> None:
    """Raise LidarError if mesh options were specified for a file that is not a mesh."""
    for name in of_mesh:
        raise LidarError(
            f"`--{name.replace('_', '-')}` only applies to mesh files, and {path} is not a "
            "mesh file."
        )


def command_arguments(of_mesh: Mapping[str, Any]) -> Iterator[str]:
    """Yield the command-line arguments that set the mesh options in `of_mesh`."""
    for name, value in of_mesh.items():
        for item in value if name == "pose" else [value]:
            yield f"--{name.replace('_', '-')}"
            yield item if isinstance(item, str) else ",".join(map(str, item))


workers = click.option(
    "--workers",
    type=click.IntRange(1),
    metavar="N",
    help="Number of processes on this machine (default: depends on cores and memory).",
)


def check_workers(workers: int | None, scheduler: str | None) -> None:
    """Raise UsageError if both a number of processes and a scheduler are specified."""
    if workers is not None and scheduler is not None:
        raise click.UsageError(
            "`--workers` and `--scheduler` cannot be combined, because `--scheduler` uses the "
            "workers of the cluster."
        )


def unfinished(noun: str) -> Callable[[Command], Command]:
    """Return a decorator that adds --resume and --restart to a command."""
    return combine(
        flag("--resume", help=f"Resume an unfinished {noun}, if there is one."),
        flag("--restart", help=f"Discard an unfinished {noun} and start again."),
    )


def check_unfinished(*, resume: bool, restart: bool) -> None:
    """Raise UsageError if unfinished work is both to be resumed and to be discarded."""
    if resume and restart:
        raise click.UsageError("`--resume` and `--restart` cannot be combined.")


def scheduler(command: Command) -> Command:
    """Add the options for connecting to a running scheduler.

    The address is passed to the command as `scheduler`, and the certificates are passed as `files`.
    All options are validated before the command is called.
    """

    @wraps(command)
    def with_files(*arguments: Any, **settings: Any) -> None:
        files = TlsFiles(*(settings.pop(f"tls_{part}") for part in ("ca", "cert", "key")))
        file = settings.pop("scheduler_file")
        _check_combination(settings, file, files)
        address = _scheduler_address(settings["scheduler"], file, settings.get("startup_timeout_s"))
        if address is not None:
            check_certificates(address, files)
        command(*arguments, files=files, **settings | {"scheduler": address})

    pem = click.Path(exists=True, dir_okay=False, path_type=Path)
    for name, description in (
        ("key", "Private key of the client certificate, if it is in a separate file (PEM)."),
        ("cert", "Client certificate for a TLS cluster (PEM)."),
        ("ca", "CA certificate of a TLS cluster (PEM)."),
    ):
        click.option(f"--tls-{name}", type=pem, help=description)(with_files)
    click.option(
        "--scheduler-file",
        type=click.Path(dir_okay=False, path_type=Path),
        help="File that contains the address of the scheduler, as written by dask scheduler "
        "--scheduler-file.",
    )(with_files)
    return click.option(
        "--scheduler",
        metavar="ADDRESS",
        help="Address of a running Dask scheduler, such as tcp://host:8786, or a scheduler file.",
    )(with_files)


def _check_combination(settings: Mapping[str, Any], file: Path | None, files: TlsFiles) -> None:
    """Raise an error if options that select a cluster contradict each other.

    Raise UsageError for options that cannot be combined, or LidarError if a certificate file cannot
    be read.
    """
    from lidarsim.io.input_files import input_size

    if settings["scheduler"] is not None and file is not None:
        raise click.UsageError("`--scheduler` and `--scheduler-file` cannot be combined.")
    has_scheduler = settings["scheduler"] is not None or file is not None
    starts_cluster = settings.get("cluster") is not None
    if starts_cluster and has_scheduler:
        raise click.UsageError(
            "`--cluster` and `--scheduler` cannot be combined, because `--cluster` starts a "
            "cluster and `--scheduler` connects to a running one."
        )
    if settings.get("tls") and (starts_cluster or has_scheduler):
        raise click.UsageError(
            "`--tls` can only be used with the local cluster. A cluster that `--cluster` starts "
            "is encrypted if its file enables TLS, and a cluster that `--scheduler` connects to "
            "is encrypted if its address begins with tls://."
        )
    if any(files) and not has_scheduler:
        raise click.UsageError(
            "`--tls-ca`, `--tls-cert` and `--tls-key` require `--scheduler` with the address "
            "of an encrypted cluster, such as tls://host:8786."
        )
    for pem in filter(None, files):
        with explain_os_errors(f"{pem} cannot be read"):
            input_size(pem)


def _scheduler_address(
    given: str | None, file: Path | None, startup_timeout_s: float | None
) -> str | None:
    """Return the validated scheduler address from --scheduler or --scheduler-file."""
    if given is not None and is_scheduler_file(given):
        file = Path(given)
    if file is not None:
        return read_scheduler_file(
            file, startup_timeout_s or 0.0, lambda text: click.echo(f"note: {text}", err=True)
        )
    if given is not None:
        check_address(given)
    return given


def world_lines(epsg: int | None, origin: Sequence[float]) -> Iterator[str]:
    """Yield a line about the output's coordinate system and origin.

    Yield nothing if the output has neither an EPSG code nor an origin.
    """
    from lidarsim.scene.files.coordinate_systems import describe_system

    if epsg is None and not any(origin):
        return
    system = "no EPSG code" if epsg is None else describe_system(epsg)
    added = ", ".join(f"{value:,.12g}" for value in origin)
    moved = f"; ({added}) m is added to the coordinates of the scenario" if any(origin) else ""
    yield f"world       {system}{moved}"


def print_results(figures: Mapping[str, Any], lines: Iterable[str], as_json: bool) -> None:
    """Print results as a JSON document or as lines of text."""
    if as_json:
        lines = [json.dumps(figures, indent=1, allow_nan=False, default=str)]
    for line in lines:
        click.echo(line)


@contextmanager
def summary_at_end(summary: Callable[[], str]) -> Iterator[None]:
    """Print a summary after the body, even if Ctrl-C interrupts it."""
    try:
        yield
    except KeyboardInterrupt as error:
        if words := summary():
            error.add_note(words)
        raise
    if words := summary():
        click.echo(words)
