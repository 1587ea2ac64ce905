"""The `lidarpool` command.

Command modules import heavy dependencies inside functions, so that help and shell completion
respond immediately.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable
from dataclasses import asdict, fields, replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click
from click.shell_completion import CompletionItem

from lidarlive.viewers.viewer_table import PAGE, VIEWERS
from lidarscenario.shard import ALL
from lidarsim._version import __version__
from lidarsim.environment.interrupts import (
    INTERRUPTED,
    STOPPED,
    UNTOUCHED,
    defer_interrupts,
    interrupt_on_signals,
)
from lidarsim.environment.plugins import find_plugin, plugins_of
from lidarsim.errors import LidarError
from lidarsim.schema.vocabulary import PATIENCE_S, QUEUE_S, WAIT_S
from lidarsim.words import plural

from ..processes.logs import set_logs
from ..processes.rare_collections import no_collections
from . import completion
from . import shared_options as shared
from .augment_command import augment
from .compare_command import compare
from .first_step import print_first_step
from .flight_command import flight
from .follow_command import follow
from .mount_command import mount
from .occupancy_command import occupancy
from .play_command import play
from .result_commands import export, fit, plot, view
from .scenario_commands import check, import_, init, scene, schema, sensors
from .serve_command import serve
from .stations_command import stations
from .twin_command import twin

if TYPE_CHECKING:
    from poolpart import WorkerInfo

    from ..connection.tls_files import TlsFiles
    from ..run.options import RunOptions
    from .terminal import Terminal

PROGRAM = "lidarpool"
PLUGINS = "lidarpool.commands"  # entry point group for click.Command objects

# Options of both `demo` and `run`. Many of them are fields of RunOptions.
_common_options = shared.combine(
    shared.flag("--tls", help="Encrypt the traffic of the local cluster."),
    click.option(
        "--live",
        type=click.Choice([PAGE, *VIEWERS]),
        shell_complete=completion.live,
        help="Show the progress and the point cloud in the browser (default), in Foxglove or in "
        "Rerun, until Ctrl-C is pressed.",
    ),
    click.option(
        "--exit",
        "stay",
        flag_value=False,
        default=True,
        help="With --live, exit when the run ends.",
    ),
    click.option(
        "--pace",
        type=shared.Number(0, min_open=True),
        metavar="SPEED",
        help="With --live, show frames in order at this multiple of the scan rate (default: show "
        "each frame as soon as it is simulated). Not for campaigns.",
    ),
    shared.flag(
        "--cloud-only", help="Write only the point cloud and report.json, without report.html."
    ),
    shared.flag("--overwrite", help="Overwrite a data set or the result of a different survey."),
    shared.path(
        "--timeline",
        help="Print the duration of each startup and shutdown step, and write the durations to "
        "FILE as an HTML page.",
    ),
    shared.flag("--quiet", "-q", help="Do not show progress."),
    shared.flag("--verbose", "-v", help="Show log messages of Dask and other libraries."),
    shared.strict,
    shared.as_json,
)


def _parse_duration(text: str) -> float:
    """Convert a duration such as 90, 90s, 10m or 2h to seconds."""
    unit = {"s": 1, "m": 60, "h": 3600}.get(text[-1:])
    try:
        seconds = float(text[:-1]) * unit if unit else float(text)
    except ValueError:
        seconds = math.nan
    if not math.isfinite(seconds):
        raise click.BadParameter(
            f"{text!r} is not a duration. Expected a number with the unit s, m or h, such as 90s."
        )
    return seconds


def _with_run_options(command: Callable[..., None]) -> Callable[..., None]:
    """Return a wrapper that passes a Terminal and RunOptions to a command.

    The remaining options are passed as keyword arguments. A fork server imports the modules that
    workers require in the background.
    """

    @wraps(command)
    def prepared(
        *,
        quiet: bool,
        verbose: bool,
        as_json: bool,
        cluster: Path | None = None,
        cloud_only: bool,
        strict: bool,
        pictures: bool = False,
        timeline: Path | None = None,
        **settings: Any,
    ) -> None:
        if cloud_only and pictures:
            raise click.UsageError("`--cloud-only` and `--pictures` cannot be combined.")
        if settings.get("pace") and not settings.get("live"):
            raise click.UsageError("`--pace` requires `--live`.")
        settings["extent"] = "pictures" if pictures else "cloud" if cloud_only else None
        print_first_step(
            f"reading the {'data set' if settings.get('verify') else 'scene'}", quiet=quiet
        )
        from lidarfiles.processes.freed_memory import keep_freed_memory

        from ..processes import timeline as steps
        from ..processes.fork_server import start_fork_server, stop_fork_server

        if timeline is not None:
            steps.timeline.show_at_exit(timeline)
        keep_freed_memory()
        if cluster is None and settings.get("scheduler") is None:
            start_fork_server()
        try:
            # An interrupted import cannot be repeated.
            with defer_interrupts(), no_collections():
                from ..run.cluster_file import ClusterFile
                from ..run.options import RunOptions
                from . import run_command  # noqa: F401
                from .terminal import Terminal
            steps.record_step(steps.COMMAND)
            set_logs(verbose)
            run_settings: dict[str, Any] = {}
            if cluster is not None:
                run_settings = {"cluster": ClusterFile.load(cluster), "startup_timeout_s": QUEUE_S}
                run_settings["worker_timeout_s"] = QUEUE_S
            # The backend is passed separately, because the scenario may also specify it.
            names = {field.name for field in fields(RunOptions)} - {"backend"}
            run_settings |= {
                name: value
                for name, value in settings.items()
                if name in names and value is not None
            }
            further_settings = {
                name: value for name, value in settings.items() if name not in names
            }
            terminal = Terminal(quiet, verbose, as_json)
            command(terminal, RunOptions(**run_settings), **further_settings)
            terminal.exit_if_warned(strict=strict)
        finally:
            stop_fork_server()

    return prepared


class _LiveCommand(click.Command):
    """Command whose option --live works with or without a value, even before an argument."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Insert the default value of --live if it has no value, and parse the arguments."""
        # The word that is being completed may be the value of --live.
        if ctx.resilient_parsing and args[-1:] == ["--live"]:
            args = args[:-1]
        values = {PAGE, *VIEWERS}
        followers = [*args[1:], ""][: len(args)]
        return super().parse_args(
            ctx,
            [
                f"--live={PAGE}" if word == "--live" and follower not in values else word
                for word, follower in zip(args, followers, strict=True)
            ],
        )


class _Commands(click.Group):
    """Command group that includes the commands of plug-ins."""

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the command with this name, or None if there is none.

        Raises
        ------
        LidarError
            If the command belongs to a plug-in that cannot be used.
        """
        command = super().get_command(ctx, cmd_name)
        if command is None and (plugin := find_plugin(PLUGINS, cmd_name)) is not None:
            return plugin.load(click.Command)
        return command

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        items = super().shell_complete(ctx, incomplete)
        return items or completion.starting_with(incomplete, plugins_of(PLUGINS))

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands in the help text, without importing plug-ins."""
        super().format_commands(ctx, formatter)
        rows = [
            (name, " and ".join(f"{plugin.distribution} {plugin.version}" for plugin in plugins))
            for name, plugins in plugins_of(PLUGINS).items()
            if name not in self.commands
        ]
        if rows:
            with formatter.section("Commands of plug-ins"):
                formatter.write_dl(rows)


@click.group(
    cls=_Commands,
    commands=[
        *(init, import_, check, schema, scene, sensors, stations, flight, mount),
        *(view, play, follow, serve, plot, export, compare, fit, twin, augment, occupancy),
    ],
    context_settings={"max_content_width": 100, "help_option_names": ["-h", "--help"]},
)
@click.version_option(__version__, prog_name=PROGRAM)
def cli() -> None:
    """Simulate lidar surveys on a partitioned Dask cluster."""


@cli.command(cls=_LiveCommand)
@shared.out
@_common_options
@_with_run_options
def demo(terminal: Terminal, options: RunOptions, out: Any, extent: str | None) -> None:
    """Run the demo: scan six objects, plan a path, and draw pictures.

    The demo runs examples/seed.yaml on this machine.

    \b
    Examples:
      lidarpool demo --live
      lidarpool demo --out /tmp/demo
    """  # noqa: D301 - Click requires the character \b
    from lidarscenario.demo import demo_scenario

    from .run_command import run_scenario

    run_scenario(demo_scenario(), out, terminal, options, extent=extent or "pictures")


@cli.command(cls=_LiveCommand)
@click.argument("scenarios", metavar="SCENARIO...", nargs=-1, required=True, type=click.Path())
@shared.mesh_options
@shared.out
@shared.scheduler
@shared.cluster
@shared.backend
@shared.flag("--pictures", help="Draw pictures of the result; lidarpool plot can do this later.")
@shared.flag("--resume", help="Resume an unfinished run, if there is one.")
@shared.flag("--restart", help="Discard an unfinished run and start again.")
@shared.flag("--retry-failed", help="Run the failed jobs of a campaign again.")
@shared.flag(
    "--verify",
    help="Verify the checksums of a data set, or those of the finished jobs before a campaign is "
    "resumed.",
)
@shared.job
@shared.shard
@click.option(
    "--scratch-dir",
    metavar="PLACE",
    help="Folder or URL (s3://…) where LIDAR workers store points during the run (default: in the "
    "output folder).",
)
@click.option(
    "--startup-timeout",
    "startup_timeout_s",
    type=_parse_duration,
    metavar="TIME",
    help="Maximum time to wait for the scheduler and the workers at startup, such as 90s or 10m "
    f"(default: {WAIT_S:g}s; with --cluster {QUEUE_S / 3600:g}h).",
)
@click.option(
    "--worker-timeout",
    "worker_timeout_s",
    type=_parse_duration,
    metavar="TIME",
    help="Maximum time to wait for new workers if a partition loses all its workers during the run "
    f"(default: {PATIENCE_S:g}s; with --cluster {QUEUE_S / 3600:g}h).",
)
@_common_options
@_with_run_options
def run(
    terminal: Terminal,
    options: RunOptions,
    scenarios: tuple[str, ...],
    out: Any,
    *,
    of_mesh: dict[str, Any],
    extent: str | None,
    number: int | None,
    backend: str | None,
    **settings: Any,
) -> None:
    """Simulate a survey, or a campaign of surveys.

    SCENARIO is a scenario file, a mesh file or a campaign file. A campaign file or several
    scenarios produce a single data set.

    For a mesh file, poses are chosen automatically unless --pose is given: rooms and landscapes are
    scanned from the center of the floor, and objects from all sides. To create a scenario file with
    the same options, use lidarpool init DIR --mesh FILE.

    \b
    Examples:
      lidarpool run examples/seed.yaml --out seed
      lidarpool run hall.glb --resume --scheduler tcp://127.0.0.1:8786
      lidarpool run part.stl --unit mm --sensor ouster/os1-64 --pose 0,0,1.9 --format las
      lidarpool run examples/seed.yaml --cluster examples/clusters/slurm.yaml
      lidarpool run examples/campaign.yaml --out dataset
      lidarpool run examples/campaign.yaml --shard 3/10 --out part-3
      lidarpool run --verify dataset
    """  # noqa: D301 - Click requires the character \b
    from lidarscenario.campaign.campaign_file import is_campaign
    from lidarscenario.scenario import Scenario
    from lidarsim.io.storage import Storage

    from ..run.store.run_store import RUN_FOLDER
    from .run_command import run_campaign, run_job, run_scenario

    if number is not None and settings["shard"] is not None:
        raise click.UsageError("`--job` and `--shard` cannot be combined.")
    if options.retry_failed and number is not None:
        raise click.UsageError("`--retry-failed` cannot be combined with `--job`.")
    paths = [*map(Path, scenarios)]
    if options.verify and not paths[0].is_file():
        from ..report.campaign_output import verify_dataset

        click.echo(verify_dataset(Storage.at(scenarios[0])))
        return
    options = replace(options, folder=Storage.at(out).below(RUN_FOLDER))
    is_several = len(paths) > 1
    if of_mesh and is_several:
        raise click.UsageError(
            "`--sensor`, `--pose` and the other mesh options require a single mesh file. Run "
            "the files one by one."
        )
    if is_several or (not of_mesh and is_campaign(paths[0])):
        from lidarscenario.campaign.campaign import CampaignSpec

        campaign = CampaignSpec.from_scenarios(paths) if is_several else CampaignSpec.load(paths[0])
        if number is not None:
            run_job(campaign, number, out, terminal, options, backend, extent)
        elif extent is not None:
            raise click.UsageError("`--cloud-only` and `--pictures` cannot be used with campaigns.")
        else:
            campaign = campaign.for_shard(settings["shard"] or ALL)
            run_campaign(campaign, out, terminal, options, backend)
    elif options.retry_failed or options.verify or number is not None:
        raise click.UsageError(
            "`--job`, `--retry-failed` and `--verify` can only be used with campaigns."
        )
    else:
        scenario = Scenario.load(paths[0], of_mesh)
        settings["scenario_source"] = {"path": str(paths[0].absolute()), "options": of_mesh}
        run_scenario(scenario, out, terminal, options, backend, extent=extent, **settings)


@cli.command()
@click.argument("shards", metavar="SHARD...", nargs=-1, required=True, type=shared.StoragePath())
@click.option(
    "--partial", is_flag=True, help="Merge the available shards, and report the missing ones."
)
@shared.path("--scenario", help="Scenario or mesh file of the survey, if it has been moved.")
@shared.out
@shared.flag("--quiet", "-q", help="Do not show progress.")
@shared.strict
@shared.as_json
def merge(
    shards: tuple[Any, ...], out: Any, quiet: bool, strict: bool, as_json: bool, **settings: Any
) -> None:
    """Merge shards into a data set or a result.

    If a merge was interrupted, run the same command again to continue.

    \b
    Examples:
      lidarpool merge part-* --out dataset
      lidarpool merge s3://lab/part-1 s3://lab/part-2 --out s3://lab/dataset
    """  # noqa: D301 - Click requires the character \b
    from ..report.merging import merge as merge_shards
    from .terminal import Terminal

    screen = Terminal(quiet, False, as_json)
    report = merge_shards(shards, out, screen=screen, **settings)
    points = report["points"] if "points" in report else report["totals"]["points"]
    jobs = f"{plural(report['jobs']['done'], 'job')}, " if "jobs" in report else ""
    lines = [*screen.notes(report["notes"]), f"{jobs}{plural(points, 'point')} in {out}"]
    shared.print_results({"folder": str(out), **report}, lines, as_json)
    screen.exit_if_warned(strict=strict)


@cli.command()
@shared.scheduler
@shared.as_json
def doctor(scheduler: str | None, files: TlsFiles, as_json: bool) -> None:
    """Check the installation and cluster workers, and suggest fixes.

    \b
    Examples:
      lidarpool doctor
      lidarpool doctor --scheduler tcp://127.0.0.1:8786
    """  # noqa: D301 - Click requires the character \b
    from poolpart import Pool

    from ..run.cluster.connection import connect_client
    from .doctor import advice_line, check_environment, find_cluster_fault, result_lines

    found: Iterable[WorkerInfo] = ()
    fault = ""
    if scheduler is not None:
        with connect_client(scheduler, files) as client:
            pool = Pool.from_client(client)
            found = pool.workers
            fault = find_cluster_fault(pool)
    workers = sorted(found, key=lambda worker: (sorted(worker.resources), worker.name))
    figures = check_environment(fault)
    figures["workers"] = [asdict(worker) for worker in workers]
    lines = result_lines(figures)
    if scheduler is not None:
        hosts = plural(len({worker.host for worker in workers}), "host")
        lines.append(f"cluster: {plural(len(workers), 'worker')} on {hosts}")
    for worker in workers:
        partitions = ", ".join(
            f"{name}={slots:g}" for name, slots in sorted(worker.resources.items())
        )
        name = f"{worker.name}  " if worker.name != worker.address else ""
        lines.append(
            f"  {partitions or 'no partition':<12} {name}{worker.address}  "
            f"{plural(worker.nthreads, 'thread')}  {worker.memory / 2**30:.1f} GiB  "
            f"{plural(len(worker.gpus), 'GPU')}"
        )
    lines.append(advice_line(figures))
    shared.print_results(figures, lines, as_json)


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command and exit the process.

    The exit code is 0 for success, 1 for warnings with --strict, 2 for errors that the user can
    correct, and 130 for an interrupt. Other exceptions are defects and are not caught.
    """
    interrupt_on_signals()
    set_logs(shown=False)
    try:
        cli.main(args=arguments, prog_name=PROGRAM, standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
    except (KeyboardInterrupt, click.Abort) as error:
        _exit_with_message(f"{STOPPED}." if _notes(error) else UNTOUCHED, error, INTERRUPTED)
    except Exception as error:
        if (message := _user_error_message(error)) is None:  # a defect
            raise
        _exit_with_message(message, error)
    sys.exit(0)


def _user_error_message(error: Exception) -> str | None:
    """Return the message for an error that the user can correct, or None for any other error."""
    match error:
        case click.MissingParameter():
            usage = error.ctx.get_usage() if error.ctx else ""
            message = " ".join(error.format_message().split())  # Click lists choices on new lines
            return f"{message}\n{usage}"
        case click.ClickException():
            return error.format_message()
        case OSError(filename=str() | Path() as name):
            # The file name is invalid, or access was denied.
            return f"{name} cannot be accessed: {error.strerror}. Use another file or folder."
        case MemoryError():
            return "Not enough memory. Use a smaller scene, fewer scans or a larger keep_every."
        case LidarError():
            return str(error)
        case RuntimeError():
            from poolpart import PoolError

            return str(error) if isinstance(error, PoolError) else None
    return None


def _notes(error: BaseException | None) -> list[str]:
    """Return the notes that were added to an error or to its cause."""
    while error is not None:
        if notes := getattr(error, "__notes__", []):
            return list(notes)
        error = error.__cause__ or error.__context__
    return []


def _exit_with_message(message: str, error: BaseException | None = None, code: int = 2) -> NoReturn:
    """Print a message and the notes of an error to stderr, and exit the process."""
    message = " ".join([message, *_notes(error)])
    # Names from files may contain control characters, which must not reach the terminal.
    message = "".join(c if c.isprintable() or c == "\n" else "\ufffd" for c in message)
    click.echo(f"lidarpool: {message}", err=True)
    sys.exit(code)
