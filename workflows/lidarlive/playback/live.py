"""Play a scanner as a live sensor in a program that moves the sensor itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import count
from typing import Any

from lidarfiles.processes.freed_memory import keep_freed_memory
from lidarsim.columns.cloud import Cloud
from lidarsim.errors import LidarError
from lidarsim.motion.trajectory import Pose, Trajectory
from lidarsim.numerics.arrays import Ints
from lidarsim.packets.encoders import Datagrams
from lidarsim.packets.sweep_packets import Packets
from lidarsim.schema.checks import check_number, check_type
from lidarsim.simulator import Scanner
from lidarsim.words import join_names

from ..devices.send import LOOPBACK, Lateness
from .schedule import BEHIND, BEHIND_S, Prefetcher, Schedule, casting_threads
from .transmitter import Transmitter, sensor_streams

_AHEAD = 16  # sweeps that are simulated in advance if the trajectory is known
_START_NS = 20e6  # time between the start of the schedule and the first packet
_NumberedSweep = tuple[int, float, Cloud]  # number, start in seconds, points


def play(
    scanner: Scanner,
    trajectory: Pose | Trajectory | Callable[[float], Any] | Sequence[float],
    *,
    to: str = LOOPBACK,
    api: str = "",
    rate: float = 1.0,
    duration_s: float | None = None,
    start: Any = None,
    ready: Callable[[str], Any] | None = None,
    note: Callable[[str], Any] | None = None,
) -> Lateness:
    """Send the packets of a scanner in real time, like a real sensor.

    Parameters
    ----------
    scanner
        Scanner, which must have the columns of `Packets`. If a pose or trajectory is passed, its
        sweeps are simulated in parallel, one on each core, so ``threads=1`` is fastest in this
        case.
    trajectory
        Pose of a stationary sensor, trajectory of a moving sensor, or a function that returns the
        pose or trajectory of the sweep that starts at a given time in seconds. At the end of a
        trajectory, `play` returns. The function is called in the calling thread, up to one sweep
        before the sweep starts. Consecutive poses can be far apart.
    to, api
        Destination of the packets, and address on which the sensor interface listens, as HOST or
        HOST:PORT, as for `lidarpool play`.
    rate
        Playback speed. For example, playback at 0.5 takes twice as long.
    duration_s
        Duration in seconds of scanner time. By default, it is the length of the trajectory. Without
        a trajectory, packets are sent until Ctrl-C.
    start
        Date and time that correspond to time 0 in the timestamps, as in `Survey`.
    ready, note
        Functions that are called with the addresses once the scanner is ready, and with notes for
        the user.

    Returns
    -------
    Lateness
        Number of packets that were sent, and how late they were.

    Raises
    ------
    LidarError
        If the scanner lacks a column, if the packets of the sensor are not supported, or if an
        address cannot be used.

    Examples
    --------
    >>> from lidarpool import Packets, Pose, Scanner, Scene, load_sensor, play
    >>> packets = Packets(load_sensor("velodyne/vlp16"))
    >>> scanner = Scanner(Scene.seed(), load_sensor("velodyne/vlp16"), columns=packets.columns)
    >>> lateness = play(scanner, Pose((0, 0, 1)), duration_s=0.3)
    >>> lateness.sent
    242
    """
    check_type("scanner", scanner, Scanner)
    check_number("rate", rate, ge=0.001, le=1000)
    if duration_s is not None:
        check_number("duration_s", duration_s, gt=0)
    keep_freed_memory()
    packets = Packets.for_scanner(scanner, start)
    names = {column.name for column in scanner.survey.stored_columns}
    if missing := [name for name in packets.columns if name not in names]:
        columns = "column" if len(missing) == 1 else "columns"
        raise LidarError(
            f"Packets require the {columns} {join_names(missing)}, which the scanner does not "
            "compute. Create the scanner with columns=Packets(sensor).columns."
        )
    streams = sensor_streams([packets.encoder], [to], [api] if api else [])
    sweeps = _sweeps(scanner, trajectory, duration_s)
    with Transmitter(streams, note or (lambda words: None)) as transmitter:
        if callable(trajectory):  # the next pose is only known when its sweep is due
            clouds = (task() for task in sweeps)
            _send_all(packets, clouds, Schedule(rate), transmitter, ready, note)
        else:
            with Prefetcher(sweeps, _AHEAD, casting_threads()) as prefetcher:
                _send_all(packets, iter(prefetcher), Schedule(rate), transmitter, ready, note)
        transmitter.sender.finish()
    return transmitter.sender.lateness


def _sweeps(
    scanner: Scanner, trajectory: Any, duration_s: float | None
) -> Iterator[Callable[[], _NumberedSweep]]:
    """For each sweep until the trajectory or duration ends, yield a function that simulates it."""
    end_s = getattr(trajectory, "duration_ns", float("inf")) / 1e9
    for number in count():
        first_s, last_s = scanner.span_s(number)
        if last_s > end_s or first_s >= (duration_s or float("inf")):
            return
        pose = trajectory(first_s) if callable(trajectory) else trajectory
        yield partial(_cast, scanner, pose, number, first_s)


def _cast(scanner: Scanner, pose: Any, number: int, start_s: float) -> _NumberedSweep:
    return number, start_s, scanner.sweep(pose, number=number)


def _send_all(
    packets: Packets,
    sweeps: Iterator[_NumberedSweep],
    schedule: Schedule,
    transmitter: Transmitter,
    ready: Callable[[str], Any] | None,
    note: Callable[[str], Any] | None,
) -> None:
    """Encode all sweeps, and pass their packets to the sending process.

    Packets are passed at most one sweep in advance.
    """

    def send(groups: list[Datagrams]) -> None:
        transmitter.sender.send(0, groups, deadlines_ns)

    def deadlines_ns(due_ns: Ints) -> Ints:
        """Convert packet times to deadlines. The schedule starts with the first datagrams."""
        if not schedule.is_started:
            schedule.start(float(due_ns.min()), _START_NS)
        return schedule.deadlines_ns(due_ns)

    for number, start_s, points in sweeps:
        groups = packets.encode(points, number=number)
        if not schedule.is_started:
            if ready is not None:
                ready(f"ready: {transmitter.description}")
        elif note is not None and schedule.late_s(start_s * 1e9) > BEHIND_S:
            note(BEHIND)
            note = None
        send(groups)
        schedule.wait_until(start_s * 1e9)  # The next sweep is requested one sweep in advance.
    send(packets.finish())
