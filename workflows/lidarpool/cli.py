"""The command `lidarpool`."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NoReturn

import click
from distributed import Client

from poolpart import Pool, PoolError
from poolpart.probe import visible_gpus
from raybeam import available_backends

from ._version import __version__
from .checks import check_backend_here, check_backend_name, check_precision
from .complaints import did_you_mean
from .connection import connected, local_client
from .errors import LidarpoolError
from .interrupts import INTERRUPTED, interrupt_on_signals
from .quiet import QuietWorkers, silence_logs
from .report import versions
from .result import Result
from .scenario import Scenario
from .scene import Scene
from .scene_commands import scene
from .simulate import simulate
from .survey import Survey
from .terminal import shown_progress, shown_status
from .tls import NO_FILES, TlsFiles

_out = click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("lidarpool-out"),
    show_default=True,
    help="Folder for the results; made if it is not there.",
)
_quiet = click.option("--quiet", "-q", is_flag=True, help="No progress, only the result.")

_tls = click.option("--tls", is_flag=True, help="Encrypt the traffic of the local cluster.")


def _tls_files(command: Callable[..., None]) -> Callable[..., None]:
    """Options for the certificates of an encrypted cluster."""
    for name, what in (
        ("key", "Private key of that certificate, if its file does not hold it."),
        ("cert", "Certificate to show to an encrypted cluster, a PEM file."),
        ("ca", "Certificates of the authority of an encrypted cluster, a PEM file."),
    ):
        command = click.option(f"--tls-{name}", type=click.Path(path_type=Path), help=what)(command)
    return command


class _Commands(click.Group):
    """Names the command that a misspelt one may have been meant to be."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command that the first argument names."""
        if args and self.get_command(ctx, args[0]) is None and not args[0].startswith("-"):
            hint = did_you_mean(args[0], self.list_commands(ctx))
            raise click.UsageError(
                f"There is no command {args[0]!r}.{hint} See lidarpool --help.", ctx
            )
        return super().resolve_command(ctx, args)


@click.group(cls=_Commands)
@click.version_option(__version__, prog_name="lidarpool")
def cli() -> None:
    """Simulate lidar surveys on a partitioned Dask cluster."""


cli.add_command(scene)


@cli.command()
@_out
@_tls
@_quiet
def demo(out: Path, tls: bool, quiet: bool) -> None:
    """Run the default survey and path planning on a cluster on this machine.

    \b
    Examples:
      lidarpool demo
      lidarpool demo --out /tmp/demo
    """  # noqa: D301 - click wants the character, not its name
    _run(Scenario(), out, tls=tls, quiet=quiet)


@cli.command()
@click.argument("scenario", type=click.Path(path_type=Path))
@_out
@click.option("--scheduler", metavar="ADDRESS", help="Use this Dask cluster, tcp://host:8786.")
@_tls_files
@_tls
@click.option(
    "--backend",
    metavar="[auto|cuda|embree|numpy]",
    help="Ray caster of stage 2; by default the scenario's, else the fastest there is.",
)
@click.option("--no-plan", is_flag=True, help="Leave the path planning out.")
@_quiet
def run(
    scenario: Path,
    out: Path,
    scheduler: str | None,
    backend: str | None,
    no_plan: bool,
    quiet: bool,
    tls: bool,
    tls_ca: Path | None,
    tls_cert: Path | None,
    tls_key: Path | None,
) -> None:
    """Run a survey from a scenario file, or of a mesh file from its middle.

    \b
    Examples:
      lidarpool run examples/seed.yaml --out seed
      lidarpool run hall.glb --no-plan --scheduler tcp://127.0.0.1:8786
    """  # noqa: D301 - click wants the character, not its name
    files = _files_for(scheduler, tls_ca, tls_cert, tls_key)
    if tls and scheduler is not None:
        raise click.UsageError(
            "--tls is for a cluster of this machine; that of --scheduler is encrypted if its "
            "address begins with tls://."
        )
    _run(Scenario.load(scenario), out, scheduler, backend, no_plan, quiet, tls, files)


def _files_for(scheduler: str | None, *files: Path | None) -> TlsFiles:
    """Certificates as one; an error if there is no scheduler to use them with."""
    if any(files) and scheduler is None:
        raise click.UsageError(
            "--tls-ca, --tls-cert and --tls-key are for the cluster of --scheduler: give its "
            "address, tls://host:8786, or --tls for an encrypted cluster of this machine."
        )
    return TlsFiles(*files)


def _run(
    scenario: Scenario,
    out: Path,
    scheduler: str | None = None,
    backend: str | None = None,
    no_plan: bool = False,
    quiet: bool = False,
    tls: bool = False,
    files: TlsFiles = NO_FILES,
) -> None:
    # Matplotlib is a third of the time that --help would take.
    from .output import result_folder, write_result

    backend = backend or scenario.pool.backend
    (check_backend_here if scheduler is None else check_backend_name)(backend)
    scene = scenario.build_scene()
    survey = scenario.survey(scene)
    planning = None if no_plan else scenario.plan(scene)
    check_precision(scene, survey)
    pool = scenario.pool
    with result_folder(out):
        with (
            _local_client(scenario, quiet, tls)
            if scheduler is None
            else connected(scheduler, files) as client,
            shown_progress(quiet) as show,
        ):
            result = simulate(
                scene,
                survey,
                planning,
                client=client,
                backend=backend,
                on_progress=show,
                queue_capacity=pool.queue_capacity,
                collectors=pool.collectors,
            )
        with shown_status("writing the cloud, the pictures and the report", quiet):
            report = write_result(out, result, scene, survey, planning)
    _tell(out, result, scene, survey, report["files"])


def _tell(out: Path, result: Result, scene: Scene, survey: Survey, files: list[str]) -> None:
    for note in result.notes:
        click.echo(f"note: {note}")
    click.echo(
        f"{survey.scan_count:,} scans, {result.rays:,} rays, {result.hits:,} hits on "
        f"{len(scene.names):,} objects, {len(result.cloud):,} points in the cloud "
        f"({result.backend}, {result.survey_seconds:.1f} s)"
    )
    if result.plan is not None:
        plan = result.plan
        found = (
            f"path of {plan.length:.2f} m, free of collisions"
            if plan.collision_free
            else "no path free of collisions was found"
        )
        possible = (
            f"the shortest possible is {plan.shortest_possible:.2f} m"
            if math.isfinite(plan.shortest_possible)
            else "none is possible, the obstacles leave no way"
        )
        click.echo(f"{found}; {possible} ({plan.trials} trials, {result.planning_seconds:.1f} s)")
    click.echo(f"results in {click.format_filename(out)}: {', '.join(files)}")


@cli.command()
@click.option("--scheduler", metavar="ADDRESS", help="Also show the workers of this cluster.")
@_tls_files
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
    files = _files_for(scheduler, tls_ca, tls_cert, tls_key)
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
    click.echo(f"{pool!r}")
    for worker in sorted(pool, key=lambda worker: (sorted(worker.resources), worker.name)):
        held = ", ".join(f"{name}={slots:g}" for name, slots in sorted(worker.resources.items()))
        click.echo(
            f"  {held or 'no partition':<12} {worker.name}  {worker.address}  "
            f"{worker.nthreads} threads  {worker.memory / 2**30:.1f} GiB  {len(worker.gpus)} GPUs"
        )


@contextmanager
def _local_client(scenario: Scenario, quiet: bool, tls: bool) -> Iterator[Client]:
    """Client of a cluster on this machine whose workers say nothing of their own."""
    with ExitStack() as stack:
        with shown_status("starting the workers", quiet):
            client = stack.enter_context(
                local_client(
                    gpu_workers=scenario.pool.gpu,
                    collectors=scenario.pool.collectors,
                    other_workers=scenario.pool.other,
                    tls=tls,
                )
            )
            client.register_plugin(QuietWorkers())
        yield client


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command and exit: 0 done, 2 for what the user can put right, 130 interrupted."""
    interrupt_on_signals()
    silence_logs()
    try:
        cli.main(args=arguments, prog_name="lidarpool", standalone_mode=False)
    except (LidarpoolError, PoolError) as error:
        _die(str(error), 2)
    except click.UsageError as error:
        _die(error.format_message(), 2)
    except (KeyboardInterrupt, click.Abort):
        _die(
            "interrupted; everything was stopped, and the output folder is as it was.", INTERRUPTED
        )
    except MemoryError:
        _die("not enough memory: take a smaller scene, fewer scans or a larger keep_every.", 2)
    sys.exit(0)


def _die(message: str, code: int) -> NoReturn:
    click.echo(f"lidarpool: {message}", err=True)
    sys.exit(code)
