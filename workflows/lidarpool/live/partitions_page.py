"""The page of partitions in Dask's dashboard, while a command runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress

import click
from distributed import Client

from poolpart import has_partitions_page, partitions_page, remove_partitions_page, tell_page

from ..run.progress import Progress, Show


@contextmanager
def shown_on_page(client: Client, wanted: bool, show: Show) -> Iterator[Show]:
    """Add the page while the body runs and say where it is.

    It gives a function to call with the progress: that tells the page, and calls `show`. A page
    that somebody else has added stays.
    """
    if not wanted:
        yield show
        return
    found = has_partitions_page(client)
    click.echo(f"page of partitions: {partitions_page(client)}", err=True)

    def tell(progress: Progress) -> None:
        with suppress(OSError, RuntimeError):  # a lost cluster is for the run to tell of
            tell_page(client, **totals(progress))
        show(progress)

    try:
        yield tell
    finally:
        if not found:
            with suppress(OSError, RuntimeError):  # the cluster may be gone, and its page with it
                remove_partitions_page(client)


def totals(progress: Progress) -> dict[str, str]:
    """Tell what the page shows of a run, beside its tasks."""
    scans = f"{progress.framed:,} of {progress.scans:,}"
    state = "paused" if progress.paused else "running"
    shown = {"run": state, "scans": scans, "points": f"{progress.points:,}"}
    if progress.trials:
        shown["trials"] = f"{progress.trials_done:,} of {progress.trials:,}"
    shown["replayed"] = f"{progress.replayed:,}"
    return shown
