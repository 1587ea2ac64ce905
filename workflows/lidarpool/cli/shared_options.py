"""Options, output and logs of several commands."""

from __future__ import annotations

import json
import logging
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial, reduce, wraps
from itertools import chain
from pathlib import Path
from typing import Any

import click

from lidarsim.base.errors import explained
from lidarsim.base.storage import Storage, is_url
from lidarsim.base.vocabulary import BACKENDS, UNITS_M

from ..base.shard import Shard

Command = Callable[..., None]


class StoragePath(click.Path):
    """A folder or file, or the storage of a URL."""

    def __init__(self, **options: Any) -> None:
        super().__init__(path_type=Path, **options)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Give a Path, or a Storage."""
        return Storage.at(value) if is_url(value) else super().convert(value, param, ctx)


flag = partial(click.option, is_flag=True)
path = partial(click.option, type=click.Path(path_type=Path), metavar="FILE")
new_file = partial(click.option, type=click.Path(dir_okay=False, path_type=Path), metavar="FILE")
out = click.option(
    "--out",
    type=StoragePath(),
    default=Path("lidarpool-out"),
    show_default=True,
    help="Folder for the results, made if it does not exist, or a URL such as s3://bucket/run.",
)
backend = click.option(
    "--backend",
    type=click.Choice(BACKENDS),
    help="Ray caster of stage 2; by default the scenario's, else the fastest available.",
)
job = click.option(
    "--job", "number", type=click.IntRange(0), metavar="N", help="Of a campaign: this job alone."
)
shard = click.option(
    "--shard",
    metavar="N/OF",
    type=Shard.parse,
    help="Do one of several equal shares, such as 3/10, for lidarpool merge; auto: the task of a "
    "Slurm array; auto/10: the index of a Kubernetes job.",
)
no_plan = flag("--no-plan", help="Leave out path planning.")
cluster = path(
    "--cluster", help="Start this cluster for the run: Slurm, PBS, SSH; see docs/how-to/queues.md."
)
overwrite = flag("--overwrite", help="Replace existing files.")
as_json = flag("--json", "as_json", help="Print the figures as one JSON document.")
WARNED = 1  # exit code of --strict
strict = flag("--strict", help="Exit with code 1 if there was a warning, such as of no points.")
result = click.argument("result", metavar="FOLDER", type=StoragePath())
copies = click.option(
    "--out", type=StoragePath(file_okay=False), help="Folder for the files.  [default: FOLDER]"
)


def together(*added: Callable[[Command], Command]) -> Callable[[Command], Command]:
    """Return what adds options to a command, in their order."""
    return lambda command: reduce(lambda made, option: option(made), reversed(added), command)


def _position(text: str) -> list[float]:
    """Parse x,y,z; whole numbers stay so, to be written as they were."""
    try:
        x, y, z = map(float, text.split(","))
    except ValueError as error:
        told = f"{text!r} is no place: give x,y,z, such as 0,0,1.9; angles are for scenario files."
        raise click.BadParameter(told) from error
    return [int(one) if one.is_integer() else one for one in (x, y, z)]


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")]


def _of_mesh(name: str, what: str, **more: Any) -> Callable[[Command], Command]:
    return click.option(f"--{name}", help=f"Of a mesh: {what}.", **more)


_list_of_mesh = partial(_of_mesh, metavar="NAME,…", type=_names, multiple=True)
pose = click.option("--pose", metavar="X,Y,Z", type=_position, default="0,0,0",
                    help="Place of the sensor in the scene, metres.")  # fmt: skip
_mesh_options = together(
    _of_mesh("sensor", "sensor, one of lidarpool sensors or a file", metavar="MODEL|FILE.yaml"),
    _of_mesh("unit", "length unit; by default its own, or m", type=click.Choice([*UNITS_M])),
    _of_mesh("up-axis", "upward axis; by default its own, or z", type=click.Choice([*"xyz"])),
    _list_of_mesh("pose", "place of the sensor, metres", metavar="X,Y,Z", type=_position),
    _list_of_mesh("columns", "further columns of its points, such as range,intensity"),
    _list_of_mesh("format", "further formats of the cloud, such as las"),
)


def mesh_options(command: Command) -> Command:
    """Add what may be said of a mesh file; the command gets a dict of it, see `mesh_data`."""

    @wraps(command)
    def with_options(*arguments: Any, pose: Any, columns: Any, format: Any, **given: Any) -> None:  # noqa: A002
        said = {name: given.pop(name) for name in ("sensor", "unit", "up_axis")}
        said |= {"pose": [*pose], "columns": [*chain(*columns)], "format": [*chain(*format)]}
        said = {name: value for name, value in said.items() if value not in (None, [])}
        command(*arguments, of_mesh=said, **given)

    return _mesh_options(with_options)


def as_words(of_mesh: Mapping[str, Any]) -> Iterator[str]:
    """Yield the words of a command that give these options."""
    for name, value in of_mesh.items():
        for one in value if name == "pose" else [value]:
            yield f"--{name.replace('_', '-')}"
            yield one if isinstance(one, str) else ",".join(map(str, one))


def scheduler(command: Command) -> Command:
    """Add --scheduler and its certificates, which the command gets as `scheduler` and `files`."""

    @wraps(command)
    def with_files(*arguments: Any, **given: Any) -> None:
        from lidarsim.base.input_files import input_size

        from ..run.cluster.connection import TlsFiles

        if given.get("cluster") is not None and given["scheduler"] is not None:
            raise click.UsageError(
                "--cluster starts a cluster, --scheduler is for one that runs: give one of them."
            )
        if given.get("tls") and (given["cluster"] is not None or given["scheduler"] is not None):
            raise click.UsageError(
                "--tls is for a cluster of this machine: that of --cluster is encrypted if its "
                "file says so, that of --scheduler if its address begins with tls://."
            )
        files = TlsFiles(*(given.pop(f"tls_{part}") for part in ("ca", "cert", "key")))
        if any(files) and given["scheduler"] is None:
            raise click.UsageError(
                "--tls-ca, --tls-cert and --tls-key are for the cluster of --scheduler: give its "
                "address, tls://host:8786."
            )
        for file in filter(None, files):
            with explained(f"{file} cannot be read"):
                input_size(file)
        command(*arguments, files=files, **given)

    pem = click.Path(exists=True, dir_okay=False, path_type=Path)
    for name, what in (
        ("key", "Private key of that certificate, if its file does not hold it."),
        ("cert", "Own certificate for an encrypted cluster, a PEM file."),
        ("ca", "Certificate of the authority of an encrypted cluster, a PEM file."),
    ):
        click.option(f"--tls-{name}", type=pem, help=what)(with_files)
    return click.option(
        "--scheduler", metavar="ADDRESS", help="Use this Dask cluster, tcp://host:8786."
    )(with_files)


def show(figures: Mapping[str, Any], lines: Iterable[str], as_json: bool) -> None:
    """Print figures as one JSON document, or else what they say as lines of text."""
    if as_json:
        lines = [json.dumps(figures, indent=1, allow_nan=False, default=str)]
    for line in lines:
        click.echo(line)


def set_logs(shown: bool) -> None:
    """Show log messages and warnings of libraries in this process, or drop them.

    The command itself tells users what matters. For a log file, redirect the output of `-v`. In
    workers that share the terminal, too: the driver reports a failed task once, and Dask's worker
    would log it as well, with a traceback.
    """
    logging.disable(logging.NOTSET if shown else logging.CRITICAL)
    if shown:
        for handler in logging.getLogger("distributed").handlers:
            handler.setLevel(logging.INFO)  # a local cluster has raised it
    elif not sys.warnoptions:
        warnings.simplefilter("ignore")
