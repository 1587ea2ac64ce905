"""The command `lidarpool`."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import click

from poolpart import Pool, PoolError, WorkerInfo
from poolpart.probe import visible_gpus
from raybeam import available_backends

from .._version import __version__
from ..base.errors import LidarpoolError
from ..base.interrupts import INTERRUPTED, STOPPED, UNTOUCHED, interrupt_on_signals
from ..report.report import versions
from ..run.connection import connected
from ..scan import PATIENCE_S, WAIT_S
from ..scenario.scenario import Scenario
from .check_command import check
from .command_group import CommandGroup
from .completion import PROGRAM, complete_backend, completion
from .listeners import leaving_listeners
from .log_file import LOG
from .plot_command import plot
from .quiet import silence_logs
from .run_command import RunOptions, run_scenario
from .scenario_commands import init, schema
from .scene_commands import scene
from .tls_options import tls_file_options, tls_files_for
from .view_command import view

_out = click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("lidarpool-out"),
    show_default=True,
    help="Folder for the results; made if it is not there.",
)
# What `demo` and `run` have in common; each is a field of RunOptions.
_SHOWN = (
    click.option("--tls", is_flag=True, help="Encrypt the traffic of the local cluster."),
    click.option(
        "--live", is_flag=True, help="Show the run in the browser; the page stays until Ctrl-C."
    ),
    click.option(
        "--no-stay", "stay", flag_value=False, default=True, help="With --live: end with the run."
    ),
    click.option(
        "--page", is_flag=True, help="Add a page of partitions to Dask's dashboard, and say where."
    ),
    click.option(
        "--only",
        type=click.Choice(["cloud"]),
        help="Write the cloud and report.json, no pictures and no page.",
    ),
    click.option("--quiet", "-q", is_flag=True, help="No progress, only the result."),
    click.option(
        "--verbose",
        "-v",
        is_flag=True,
        help=f"Keep more messages in {LOG}, in the folder of --out.",
    ),
    click.option(
        "--json", "as_json", is_flag=True, help="Print the main figures as one JSON document."
    ),
)


class Duration(click.ParamType[float]):
    """A time such as 90, 90s, 10m or 2h, in seconds."""

    name = "time"

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        """Take a text apart."""
        if isinstance(value, (int, float)):
            return float(value)
        found = re.fullmatch(r"(\d+(?:\.\d+)?)(s|m|h|)", value.strip())
        if not found:
            self.fail(f"{value!r} is no time: give a number with s, m or h, as 10m.", param, ctx)
        return float(found[1]) * {"": 1, "s": 1, "m": 60, "h": 3600}[found[2]]


Command = TypeVar("Command", bound=Callable[..., None])


def _shown(command: Command) -> Command:
    """Give a command the options of `_SHOWN`, in their order."""
    for option in reversed(_SHOWN):
        command = option(command)
    return command


@click.group(cls=CommandGroup, context_settings={"max_content_width": 100})
@click.version_option(__version__, prog_name=PROGRAM)
def cli() -> None:
    """Simulate lidar surveys on a partitioned Dask cluster."""


for _command in (init, check, schema, scene, completion, view, plot):
    cli.add_command(_command)


@cli.command()
@_out
@_shown
def demo(out: Path, **shown: Any) -> None:
    """Run the default survey and path planning on a cluster on this machine.

    \b
    Examples:
      lidarpool demo --live
      lidarpool demo --out /tmp/demo
    """  # noqa: D301 - click wants the character, not its name
    run_scenario(Scenario(), RunOptions(out, resumable=False, **shown))


@cli.command()
@click.argument("scenario", type=click.Path(path_type=Path))
@_out
@click.option("--scheduler", metavar="ADDRESS", help="Use this Dask cluster, tcp://host:8786.")
@tls_file_options
@click.option(
    "--backend",
    metavar="[auto|cuda|embree|numpy]",
    shell_complete=complete_backend,
    help="Ray caster of stage 2; by default the scenario's, else the fastest there is.",
)
@click.option("--no-plan", is_flag=True, help="Leave the path planning out.")
@click.option("--resume", is_flag=True, help="Go on with an unfinished run, if there is one.")
@click.option("--fresh", is_flag=True, help="Drop an unfinished run.")
@click.option(
    "--parts",
    metavar="PLACE",
    help="Folder or URL (s3://…) that the points are written to, part by part; they stay there.",
)
@click.option(
    "--wait",
    "wait_s",
    type=Duration(),
    default=WAIT_S,
    metavar="TIME",
    help=f"Wait so long for partitions that are still empty, 90s or 10m.  [default: {WAIT_S:g}s]",
)
@click.option(
    "--patience",
    "patience_s",
    type=Duration(),
    default=PATIENCE_S,
    metavar="TIME",
    help=f"Wait so long for partitions that become empty.  [default: {PATIENCE_S:g}s]",
)
@_shown
def run(
    scenario: Path,
    out: Path,
    scheduler: str | None,
    backend: str | None,
    no_plan: bool,
    resume: bool,
    fresh: bool,
    parts: str | None,
    wait_s: float,
    patience_s: float,
    tls_ca: Path | None,
    tls_cert: Path | None,
    tls_key: Path | None,
    **shown: Any,
) -> None:
    """Run a survey from a scenario file, or of a mesh file from its middle.

    \b
    Examples:
      lidarpool run examples/seed.yaml --out seed
      lidarpool run hall.glb --no-plan --resume --scheduler tcp://127.0.0.1:8786
    """  # noqa: D301 - click wants the character, not its name
    files = tls_files_for(scheduler, tls_ca, tls_cert, tls_key)
    if shown["tls"] and scheduler is not None:
        raise click.UsageError(
            "--tls is for a cluster of this machine; that of --scheduler is encrypted if its "
            "address begins with tls://."
        )
    if resume and fresh:
        raise click.UsageError("--resume goes on with what --fresh drops: give one of them.")
    options = RunOptions(
        out,
        scheduler,
        files,
        backend=backend,
        no_plan=no_plan,
        resume=resume,
        fresh=fresh,
        parts=parts,
        wait_s=wait_s,
        patience_s=patience_s,
        **shown,
    )
    run_scenario(Scenario.load(scenario), options)


@cli.command()
@click.option("--scheduler", metavar="ADDRESS", help="Also show the workers of this cluster.")
@tls_file_options
def info(
    scheduler: str | None, tls_ca: Path | None, tls_cert: Path | None, tls_key: Path | None
) -> None:
    """Show versions, ray-casting backends, GPUs and the workers by partition.

    \b
    Examples:
      lidarpool info
      lidarpool info --scheduler tcp://127.0.0.1:8786
    """  # noqa: D301 - click wants the character, not its name
    pool = None
    files = tls_files_for(scheduler, tls_ca, tls_cert, tls_key)
    if scheduler is not None:
        with connected(scheduler, files) as client:
            pool = Pool.from_client(client)
    for name, number in versions().items():
        click.echo(f"{name:<14} {number}")
    gpus = visible_gpus()
    click.echo(f"{'GPUs here':<14} {', '.join(gpus) or 'none'}")
    click.echo("backends")
    for name, reason in available_backends().items():
        click.echo(f"  {name:<12} {reason or 'ready'}")
    if pool is not None:
        _tell_workers(pool)


def _tell_workers(pool: Pool) -> None:
    hosts = len({worker.host for worker in pool})
    click.echo(
        f"cluster: {len(pool)} worker{'s' * (len(pool) != 1)} on {hosts} host{'s' * (hosts != 1)}"
    )
    for worker in sorted(pool, key=lambda worker: (sorted(worker.resources), worker.name)):
        held = ", ".join(f"{name}={slots:g}" for name, slots in sorted(worker.resources.items()))
        click.echo(
            f"  {held or 'no partition':<12} {_called(worker)}  {worker.nthreads} "
            f"thread{'s' * (worker.nthreads != 1)}  {worker.memory / 2**30:.1f} GiB  "
            f"{len(worker.gpus) or 'no'} GPU{'s' * (len(worker.gpus) > 1)}"
        )


def _called(worker: WorkerInfo) -> str:
    """Address of a worker, after its name if it was given one."""
    named = worker.name != worker.address
    return f"{worker.name}  {worker.address}" if named else worker.address


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command and exit: 0 done, 2 for what the user can put right, 130 interrupted."""
    interrupt_on_signals()
    silence_logs()
    with leaving_listeners():
        _run(arguments)
    sys.exit(0)


def _run(arguments: list[str] | None) -> None:
    try:
        cli.main(args=arguments, prog_name=PROGRAM, standalone_mode=False)
    except (LidarpoolError, PoolError) as error:
        _die(" ".join([str(error), *_notes(error)]), 2)
    except click.UsageError as error:
        _die(error.format_message(), 2)
    except (KeyboardInterrupt, click.Abort) as error:
        _die(
            " ".join([f"{STOPPED}.", *notes]) if (notes := _notes(error)) else UNTOUCHED,
            INTERRUPTED,
        )
    except OSError as error:
        # Of a name that no file can have, or that lies in a folder which may not be looked into;
        # anything else is a defect, and shown whole.
        if error.filename is None:
            raise
        told = f"{error.filename}: {error.strerror}: give another name or folder."
        _die(" ".join([told, *_notes(error)]), 2)
    except MemoryError as error:
        advice = "not enough memory: take a smaller scene, fewer scans or a larger keep_every."
        _die(" ".join([advice, *_notes(error)]), 2)


def _notes(error: BaseException) -> list[str]:
    """List the notes of an error, or of what it came from: what was kept, and how to go on."""
    link: BaseException | None = error
    while link is not None:
        if notes := getattr(link, "__notes__", []):
            return list(notes)
        link = link.__cause__ or link.__context__
    return []


def _die(message: str, code: int) -> NoReturn:
    # Names in it may come from files, and a terminal obeys what cannot be printed.
    message = "".join(c if c.isprintable() or c == "\n" else "\ufffd" for c in message)
    click.echo(f"lidarpool: {message}", err=True)
    sys.exit(code)
