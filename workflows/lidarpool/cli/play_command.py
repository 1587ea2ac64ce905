"""The `lidarpool play` command, which plays back results and simulates scenarios in real time."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lidarfiles.clouds.built_in_formats import LAYOUTS

from . import completion
from . import shared_options as options
from .first_step import print_first_step

if TYPE_CHECKING:
    from lidarsim.io.storage import Storage

_PACKETS = "packets"
_NOW_NS = 2_000_000_000  # time to prepare the playback before the first sweep, with --now


@click.command()
@click.argument("source", metavar="SOURCE", type=options.StoragePath())
@click.option(
    "--as",
    "bridge_name",
    metavar="BRIDGE",
    shell_complete=completion.bridges,
    required=True,
    help="Output protocol: packets (network packets of the sensor), ros2 (ROS 2 topics), foxglove "
    "or rerun.",
)
@click.option(
    "--to",
    metavar="[NAME=]ADDRESS",
    multiple=True,
    help="For packets, the destination HOST or HOST:PORT; with several sensors, NAME=HOST:PORT. "
    "For viewers, the address to listen on (default: 127.0.0.1).",
)
@options.flag(
    "--loop", help="Repeat the playback, with increasing timestamps, until Ctrl-C is pressed."
)
@click.option(
    "--rate",
    type=options.Number(0.001, 1000),
    default=1.0,
    show_default=True,
    help="Playback rate; 0.5 is half speed.",
)
@options.flag(
    "--now", help="Use the current time for timestamps instead of the start time of the survey."
)
@click.option(
    "--api",
    metavar="[NAME=]ADDRESS",
    multiple=True,
    help="For packets, the address of the sensor's HTTP or command interface, HOST or HOST:PORT "
    "(default: 127.0.0.1, with port 80 or a free port).",
)
@click.option(
    "--layout",
    type=click.Choice(list(LAYOUTS)),
    help="For ros2, the point layout (default: velodyne).",
)
@click.option(
    "--pose-rate-hz",
    type=options.Number(0, 10_000, min_open=True),
    metavar="RATE",
    help="For ros2, poses per second on /tf (default: one per sweep).",
)
@click.option(
    "--organized",
    is_flag=True,
    default=None,
    help="For ros2, publish one point per ray, with NaN for rays without a return.",
)
@options.mesh_reading
@options.new_file(
    "--lateness", help="For packets, write statistics of the sending delays to FILE as JSON."
)
def play(
    source: Path | Storage,
    bridge_name: str,
    to: tuple[str, ...],
    loop: bool,
    rate: float,
    now: bool,
    of_mesh: dict[str, Any],
    **settings: Any,
) -> None:
    """Play back a result or simulate a scenario in real time.

    SOURCE is the folder of a result; a scenario, campaign or mesh file, which is simulated in real
    time; or a .pcap or .pcapng file with packets.

    \b
    Examples:
      lidarpool play drive --as packets
      lidarpool play drive.yaml --as packets --loop --now
      lidarpool play drive.yaml --as packets --to roof=127.0.0.1:2368 --to rear=127.0.0.1:2468
      lidarpool play packets/lidar.pcap --as packets --rate 0.5
      lidarpool play drive.yaml --as ros2 --layout ouster --organized
      lidarpool play drive --as foxglove --loop
    """  # noqa: D301 - Click requires the character \b
    print_first_step("reading the source")
    from lidarfiles.processes.freed_memory import keep_freed_memory
    from lidarlive.playback.bridge import BridgeOptions, bridge_class
    from lidarlive.playback.player import play_sweeps
    from lidarlive.playback.schedule import Schedule
    from lidarlive.playback.sources import open_source
    from lidarsim.packets.capture import ENDINGS

    from .terminal import Terminal

    keep_freed_memory()
    terminal = Terminal()
    kind = bridge_class(bridge_name)
    bridge_settings = {name: value for name, value in settings.items() if value not in (None, ())}
    if unknown := [name for name in bridge_settings if name not in kind.settings]:
        raise click.UsageError(f"`--{unknown[0]}` cannot be used with `--as {bridge_name}`.")
    schedule = Schedule(rate)
    if bridge_name == _PACKETS and isinstance(source, Path) and source.suffix.lower() in ENDINGS:
        if now:
            raise click.UsageError(
                "`--now` cannot be used with recorded packets, which contain their timestamps."
            )
        options.reject_mesh_options(of_mesh, source)
        _play_recording(source, to, schedule, bridge_settings, loop=loop)
        return
    with ExitStack() as stack:
        with terminal.status("reading the source", logged=False):
            needs = kind.format_of(bridge_settings)
            played = stack.enter_context(open_source(source, needs, of_mesh, terminal.report))
        sweeps = played.sweeps
        start_at_ns = 0
        if now:
            start_at_ns = time.time_ns() + _NOW_NS
            sweeps = replace(sweeps, start_ns=start_at_ns - round(float(sweeps.begins_ns.min())))
        bridge_options = BridgeOptions(to, played.period_ns if loop else 0, bridge_settings)
        bridge = kind(sweeps, schedule, bridge_options, terminal.report)
        with options.summary_at_end(lambda: bridge.summary), bridge:
            bridge.show_content(played.content)
            click.echo(f"ready: {bridge.description}. Press Ctrl-C to stop.")
            play_sweeps(
                played, bridge, schedule, terminal.report, loop=loop, start_at_ns=start_at_ns
            )


def _play_recording(
    path: Path, to: tuple[str, ...], schedule: Any, settings: dict[str, Any], *, loop: bool
) -> None:
    from lidarlive.playback.pcap_recording import PcapRecording, play_recording, recorded_streams
    from lidarlive.playback.transmitter import Transmitter

    from .terminal import Terminal

    terminal = Terminal()
    recording = PcapRecording(path)
    for note in recording.notes:
        terminal.report(note)
    streams = recorded_streams(recording, to, settings.get("api", ()))
    transmitter = Transmitter(streams, terminal.report, settings.get("lateness"))
    with options.summary_at_end(lambda: transmitter.summary), transmitter:
        click.echo(f"ready: {transmitter.description}. Press Ctrl-C to stop.")
        play_recording(recording, transmitter, schedule, loop=loop)
