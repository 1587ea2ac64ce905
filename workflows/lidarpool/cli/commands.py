"""The command `lidarpool`.

The modules of commands import what they need within functions, so that help and completion are
immediate: the imports of a run take a second.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from .._version import __version__
from ..base.errors import LidarpoolError
from ..base.interrupts import (
    INTERRUPTED,
    STOPPED,
    UNTOUCHED,
    deferred_interrupts,
    interrupt_on_signals,
)
from ..base.vocabulary import PATIENCE_S, QUEUE_S, WAIT_S
from ..base.words import plural
from . import shared_options as options
from .result_commands import compare, export, plot, view
from .scenario_commands import check, import_, init, scene, schema, sensors, stations
from .shared_options import set_logs

if TYPE_CHECKING:
    from ..base.storage import Storage
    from ..run.connection import TlsFiles

PROGRAM = "lidarpool"

# What `demo` and `run` have in common; each is a field of RunOptions.
_shown = options.together(
    options.flag("--tls", help="Encrypt the traffic of the local cluster."),
    options.flag("--live", help="Show the live page in the browser; it stays until Ctrl-C."),
    click.option(
        "--no-stay",
        "stay",
        flag_value=False,
        default=True,
        help="With --live: end the page with the run.",
    ),
    click.option(
        "--only",
        type=click.Choice(["cloud"]),
        help="Write the cloud and report.json, no pictures and no page.",
    ),
    options.flag("--overwrite", help="Replace the result of another survey, or a data set."),
    options.flag("--quiet", "-q", help="No progress, only the result."),
    options.flag("--verbose", "-v", help="Show what Dask and other libraries log, on stderr."),
    options.as_json,
)


def _seconds(text: str) -> float:
    """Parse a time such as 90, 90s, 10m or 2h."""
    unit = {"s": 1, "m": 60, "h": 3600}.get(text[-1:])
    try:
        return float(text[:-1]) * unit if unit else float(text)
    except ValueError as error:
        told = f"{text!r} is not a time: give a number with s, m or h."
        raise click.BadParameter(told) from error


@click.group(
    commands=[init, import_, check, schema, scene, sensors, stations, view, plot, export, compare],
    context_settings={"max_content_width": 100, "help_option_names": ["-h", "--help"]},
)
@click.version_option(__version__, prog_name=PROGRAM)
def cli() -> None:
    """Simulate lidar surveys on a partitioned Dask cluster."""


@cli.command()
@options.out
@_shown
def demo(**given: Any) -> None:
    """Run the default survey and plan a path, on this machine.

    \b
    Examples:
      lidarpool demo --live
      lidarpool demo --out /tmp/demo
    """  # noqa: D301 - click wants the character, not its name
    _run((), resumable=False, **given)


@cli.command()
@click.argument("scenarios", metavar="SCENARIO...", nargs=-1, required=True, type=click.Path())
@options.out
@options.scheduler
@options.cluster
@options.backend
@options.no_plan
@options.flag("--resume", help="Resume an unfinished run, if there is one.")
@options.flag("--fresh", help="Delete an unfinished run.")
@options.flag("--retry-failed", help="Of a campaign: do the jobs that have failed again.")
@options.flag("--verify", help="Compare every byte of a data set, or of the jobs to resume from.")
@options.job
@click.option(
    "--parts",
    metavar="PLACE",
    help="Folder or URL (s3://…) where LIDAR workers keep the points during the run.",
)
@click.option(
    "--wait",
    "wait_s",
    type=_seconds,
    metavar="TIME",
    help="How long to wait at the start for the scheduler and for empty partitions, such as 90s "
    f"or 10m; by default {WAIT_S:g}s, with --cluster {QUEUE_S / 3600:g}h.",
)
@click.option(
    "--patience",
    "patience_s",
    type=_seconds,
    metavar="TIME",
    help="How long to wait for partitions that become empty later; by default "
    f"{PATIENCE_S:g}s, with --cluster {QUEUE_S / 3600:g}h.",
)
@_shown
def run(scenarios: tuple[str, ...], **given: Any) -> None:
    """Run the survey of a scenario or mesh file, or a campaign of many.

    A campaign file, or several scenarios, make one data set.

    A mesh file is scanned from the middle of its floor, below the ceiling, or from around and
    above if it is an object; every hit is kept, to 1 mm. For another sensor, pose or unit of
    length, lidarpool init DIR --mesh FILE writes a scenario to edit.

    \b
    Examples:
      lidarpool run examples/seed.yaml --out seed
      lidarpool run hall.glb --no-plan --resume --scheduler tcp://127.0.0.1:8786
      lidarpool run examples/seed.yaml --cluster examples/clusters/slurm.yaml
      lidarpool run examples/campaign.yaml --out dataset
      lidarpool run --verify dataset
    """  # noqa: D301 - click wants the character, not its name
    queued = given["cluster"] is not None
    for name, default in (("wait_s", WAIT_S), ("patience_s", PATIENCE_S)):
        if given[name] is None:
            given[name] = QUEUE_S if queued else default
    if given["tls"] and (queued or given["scheduler"] is not None):
        raise click.UsageError(
            "--tls is for a cluster of this machine: that of --cluster is encrypted if its file "
            "says so, that of --scheduler if its address begins with tls://."
        )
    if (given["resume"] or given["verify"]) and given["fresh"]:
        raise click.UsageError("--resume continues the run that --fresh deletes: give one of them.")
    if given["retry_failed"] and (given["fresh"] or given["number"] is not None):
        raise click.UsageError("--retry-failed goes on with a campaign: not with --fresh or --job.")
    if given["verify"] and not Path(scenarios[0]).is_file():
        from ..base.storage import Storage
        from ..report.campaign_output import verify

        click.echo(verify(Storage.at(scenarios[0])))
        return
    _run([*map(Path, scenarios)], **given)


def _run(
    paths: Sequence[Path],
    out: Path | Storage,
    *,
    resumable: bool = True,
    no_plan: bool = False,
    number: int | None = None,
    quiet: bool,
    verbose: bool,
    as_json: bool,
    **given: Any,
) -> None:
    from ..base.fork_server import keep_freed_memory, start_fork_server, stop_fork_server

    keep_freed_memory()
    if not given.get("scheduler") and not given.get("cluster"):
        start_fork_server()  # imports what workers need in the background
    try:
        with deferred_interrupts():  # an interrupted import cannot be repeated
            from ..base.storage import Storage
            from ..run.cluster_file import ClusterFile
            from ..run.store import RUN_FOLDER
            from ..scenario.campaign import CampaignSpec, is_campaign
            from ..scenario.scenario import Scenario
            from .run_command import run_campaign, run_job, run_scenario
            from .terminal import Terminal
        if given.get("cluster") is not None:
            given["cluster"] = ClusterFile.load(given["cluster"])
        terminal = Terminal(quiet, verbose, as_json)
        set_logs(verbose)
        given |= {"out": out, "folder": Storage.at(out).below(RUN_FOLDER) if resumable else None}
        if len(paths) > 1 or (paths and is_campaign(paths[0])):
            several = len(paths) > 1
            campaign = CampaignSpec.of_scenarios(paths) if several else CampaignSpec.load(paths[0])
            if number is not None:
                run_job(campaign, number, terminal, **given)
            else:
                run_campaign(campaign, terminal, **given)
        elif given.get("retry_failed") or given.get("verify") or number is not None:
            raise click.UsageError("--job, --retry-failed and --verify are for campaigns.")
        else:
            scenario = Scenario.load(paths[0]) if paths else Scenario()
            run_scenario(scenario, terminal, no_plan=no_plan, **given)
    finally:
        stop_fork_server()


@cli.command()
@options.scheduler
@options.as_json
def info(scheduler: str | None, files: TlsFiles, as_json: bool) -> None:
    """Show versions, backends, GPUs and workers.

    \b
    Examples:
      lidarpool info
      lidarpool info --scheduler tcp://127.0.0.1:8786
    """  # noqa: D301 - click wants the character, not its name
    from poolpart import Pool
    from poolpart.probe import visible_gpus
    from raybeam import available_backends

    from ..report.report import versions
    from ..run.connection import connected

    pool = None
    if scheduler is not None:
        with connected(scheduler, files) as client:
            pool = Pool.from_client(client)
    workers = sorted(pool or (), key=lambda worker: (sorted(worker.resources), worker.name))
    told: dict[str, Any] = {
        "versions": versions(),
        "gpus": list(visible_gpus()),
        "backends": {name: reason or "ready" for name, reason in available_backends().items()},
        "workers": [asdict(worker) for worker in workers],
    }
    lines = [f"{name:<14} {number}" for name, number in told["versions"].items()]
    lines += [f"{'GPUs here':<14} {', '.join(told['gpus']) or 'none'}", "backends"]
    lines += [f"  {name:<12} {state}" for name, state in told["backends"].items()]
    if pool is not None:
        hosts = plural(len({worker.host for worker in workers}), "host")
        lines.append(f"cluster: {plural(len(workers), 'worker')} on {hosts}")
    for worker in workers:
        held = ", ".join(f"{name}={slots:g}" for name, slots in sorted(worker.resources.items()))
        name = f"{worker.name}  " if worker.name != worker.address else ""
        lines.append(
            f"  {held or 'no partition':<12} {name}{worker.address}  "
            f"{plural(worker.nthreads, 'thread')}  {worker.memory / 2**30:.1f} GiB  "
            f"{plural(len(worker.gpus), 'GPU')}"
        )
    options.show(told, lines, as_json)


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command and exit: 0 done, 2 an error of the user's, 130 interrupted."""
    interrupt_on_signals()
    set_logs(shown=False)
    try:
        cli.main(args=arguments, prog_name=PROGRAM, standalone_mode=False)
    except LidarpoolError as error:
        _die(str(error), error)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
    except click.MissingParameter as error:
        usage = error.ctx.get_usage() if error.ctx else ""
        told = " ".join(error.format_message().split())  # click gives each choice a line
        _die(f"{told}\n{usage}")
    except click.UsageError as error:
        _die(error.format_message())
    except (KeyboardInterrupt, click.Abort) as error:
        _die(f"{STOPPED}." if _notes(error) else UNTOUCHED, error, INTERRUPTED)
    except OSError as error:
        # The name is impossible for a file, or its folder may not be read; anything else is a
        # defect, and gets a traceback.
        if error.filename is None:
            raise
        _die(f"{error.filename}: {error.strerror}: give another name or folder.", error)
    except MemoryError as error:
        _die("not enough memory: take a smaller scene, fewer scans or a larger keep_every.", error)
    except RuntimeError as error:
        from poolpart import PoolError

        if not isinstance(error, PoolError):
            raise
        _die(str(error), error)
    sys.exit(0)


def _notes(error: BaseException | None) -> list[str]:
    """List the notes of an error or its cause: what was kept, and how to continue."""
    while error is not None:
        if notes := getattr(error, "__notes__", []):
            return list(notes)
        error = error.__cause__ or error.__context__
    return []


def _die(message: str, error: BaseException | None = None, code: int = 2) -> NoReturn:
    message = " ".join([message, *_notes(error)])
    # Names may come from files, and control characters would reach the terminal.
    message = "".join(c if c.isprintable() or c == "\n" else "\ufffd" for c in message)
    click.echo(f"lidarpool: {message}", err=True)
    sys.exit(code)
