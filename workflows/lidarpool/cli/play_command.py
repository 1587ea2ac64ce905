"""The command `play`: results and scenarios as live sensors."""

from __future__ import annotations

from pathlib import Path

import click

from lidarsim.base.storage import Storage

from . import shared_options as options


@click.command()
@click.argument("source", metavar="SOURCE", type=options.StoragePath())
@click.option(
    "--as", "bridge_name", metavar="BRIDGE", required=True, help="packets, foxglove or rerun."
)
@click.option(
    "--to", metavar="ADDRESS", multiple=True, help="Where to send, by default on this machine."
)
@options.flag("--loop", help="Play again and again until Ctrl-C; times go on.")
@click.option(
    "--rate", type=click.FloatRange(0, min_open=True), default=1.0, show_default=True,
    help="Speed: 0.5 takes twice as long.",
)  # fmt: skip
def play(
    source: Path | Storage, bridge_name: str, to: tuple[str, ...], loop: bool, rate: float
) -> None:
    """Play a result or scenario as its sensors would send it, at its own time.

    SOURCE: the folder of a result, or a scenario, campaign or mesh file, whose sweeps are cast as
    they are due.

    \b
    Examples:
      lidarpool play drive --as packets
      lidarpool play drive.yaml --as packets --loop
    """  # noqa: D301 - click wants the character, not its name
    from ..base.fork_server import keep_freed_memory
    from ..playback.bridge import BridgeOptions, bridge_class
    from ..playback.player import play_sweeps
    from ..playback.schedule import Schedule
    from ..playback.sources import open_source
    from .terminal import Terminal

    keep_freed_memory()
    terminal = Terminal()
    kind = bridge_class(bridge_name)
    schedule = Schedule(rate)
    with (
        open_source(source, kind.format) as played,
        kind(played.sweeps, schedule, BridgeOptions(to), terminal.tell) as bridge,
    ):
        bridge.show_content(played.content())
        click.echo(f"ready: {bridge.description}; Ctrl-C stops")
        play_sweeps(played, bridge, schedule, terminal.tell, loop=loop)
        if summary := bridge.finish():
            click.echo(summary)
