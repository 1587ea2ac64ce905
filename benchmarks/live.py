"""Measure the delay and loss of live packets.

    python -m benchmarks.live [--minutes 10]

An OS1-64 among 20 moving cars and a VLP-16 among 100 moving cars send packets, one at a time, with
7 sub-rays, rain and range noise in a city of 100,000 triangles. A receiver on the loopback
interface runs in its own process. It counts the packets and measures the delay between their
timestamps and their arrival. The sender measures how late packets are sent, relative to a schedule
that starts when the first sweeps have been cast.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from lidarpool import Actor, Noise, Packets, Returns, Scanner, Track, load_sensor, play
from lidarscenes.procedural.city import city
from lidarsim.scene.actors import box

from . import live_receiver
from .harness import argument_parser, write_results

POSITION = (0.0, 0.0, 1.9)
# Sensor, maker, cars and port by name.
CASES = {
    "OS1-64, 20 actors": ("ouster/os1-64", "ouster", 20, 17_502),
    "VLP-16, 100 actors": ("velodyne/vlp16", "velodyne", 100, 12_368),
}
LIMITS_MS = (0.5, 1, 2, 5, 10, 20, 50, 100, 1000)


def cars(count: int, seconds: float, seed: int = 7) -> list[Actor]:
    """Make cars that drive in circles around the sensor at 10 m/s."""
    random = np.random.default_rng(seed)
    times_s = np.arange(0, seconds + 3, 0.5)
    mesh = box("Car", (4.5, 1.8, 1.5))
    actors = []
    for radius_m, start in zip(
        random.uniform(5, 60, count), random.uniform(0, 2 * np.pi, count), strict=True
    ):
        angle = start + 10 / radius_m * times_s
        positions = radius_m * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        yaw = angle + np.pi / 2
        quaternions = np.stack([0 * yaw, 0 * yaw, np.sin(yaw / 2), np.cos(yaw / 2)], axis=1)
        actors.append(Actor(mesh, Track(times_s, positions, quaternions)))
    return actors


def measure(
    sensor: str, maker: str, actors: int, port: int, options: argparse.Namespace
) -> dict[str, Any]:
    """Play a sensor, and return the number of packets and their delays."""
    seconds = 60 * options.minutes
    lidar = load_sensor(sensor)
    packets = Packets(lidar)
    scanner = Scanner(
        city(options.triangles).with_actors(cars(actors, seconds)),
        lidar,
        columns=packets.columns,
        returns=Returns(subrays=7),
        noise=Noise(range_m=0.02, detection_range_m=100.0),
        rain_mm_h=10.0,
        threads=1,  # sweeps are cast beside each other
    )
    usual = list(packets.encoder.ports.values())
    ports = [port + number - usual[0] for number in usual]
    with subprocess.Popen(
        [sys.executable, str(live_receiver.__file__), maker, str(options.rate), *map(str, ports)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as receiver:
        assert receiver.stdout is not None
        receiver.stdout.readline()  # ready
        notes: list[str] = []
        start_s = time.process_time()
        lateness = play(
            scanner,
            POSITION,
            to=f"127.0.0.1:{port}",
            duration_s=seconds,
            rate=options.rate,
            ready=print,
            note=notes.append,
        )
        cpu_s = time.process_time() - start_s
        output, _ = receiver.communicate()
    received = json.loads(output)
    late_ms = np.array(received["late_ms"])
    counts = np.searchsorted(late_ms, LIMITS_MS, "right")
    return {
        "seconds": seconds,
        # Processor time of casting and encoding, of a revolution of 0.1 s.
        "cpu_ms_a_sweep": 1e3 * cpu_s / (seconds / 0.1),
        "sent": lateness.to_json(),
        "received": received["received"],
        "lost": lateness.sent - received["received"],
        "later_than_5_ms": 1 - lateness.share_within(5),
        "arrived_later_than_5_ms": float((late_ms > 5).mean()),
        "arrived_within": dict(zip(map(str, LIMITS_MS), counts.tolist(), strict=True)),
        "notes": notes,
    }


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Measure the chosen sensors and print their delays."""
    parser = argument_parser(__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--only", choices=[*CASES], nargs="*", default=[*CASES])
    parser.add_argument("--triangles", type=int, default=100_000, help="triangles of the city")
    parser.add_argument("--rate", type=float, default=1.0, help="speed; 0.1 is ten times as slow")
    options = parser.parse_args(arguments)
    results = {}
    for name in options.only:
        results[name] = row = measure(*CASES[name], options)
        print(
            f"{name}: {row['sent']['sent']:,} packets sent in {row['seconds']:g} s, {row['lost']} "
            f"lost; {row['later_than_5_ms']:.3%} sent and {row['arrived_later_than_5_ms']:.3%} "
            f"arrived more than 5 ms late; maximum delay when sent "
            f"{row['sent']['latest_ms']:.1f} ms"
        )
        print(f"  {row['cpu_ms_a_sweep']:.0f} ms of CPU time per sweep")
        print("  delay when sent", row["sent"]["lateness"])
        for note in row["notes"]:
            print(f"  note: {note}")
    write_results(options.json, results)
    return results


if __name__ == "__main__":
    main()
