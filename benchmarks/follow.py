"""CPU time and delay of `lidarpool follow` beside a stand-in for a simulator.

    python -m benchmarks.follow [--seconds 20]

The stand-in is a process that publishes /clock at 1 kHz and the poses of a robot and of 20 crates
at 100 Hz, in real time. For each sensor, the CPU time of the node is measured over the last part of
the run, after the loops have been compiled.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil

SENSORS = ("velodyne/vlp16", "ouster/os1-64")
CRATES = 20
_START_S = 25.0  # time that is not measured
_MODEL = """<model name="{name}"><pose>{x} {y} 0.5 0 0 0</pose><link name="link"><visual name="v">
<geometry><box><size>1 1 1</size></box></geometry></visual></link></model>"""
_WORLD = """<sdf version="1.9"><world name="yard">
<include><uri>model://ground_plane</uri></include>{models}
<model name="robot"><link name="lidar"/></model></world></sdf>"""


def main() -> None:
    """Measure each sensor, and print a line for it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="measured time per sensor")
    parser.add_argument("--simulate", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.simulate is not None:
        simulate(arguments.simulate)
        return
    for domain, model in enumerate(SENSORS, 60):
        print(json.dumps({"sensor": model, **measure(model, domain, arguments.seconds)}))


def positions(time_s: float) -> list[tuple[str, float, float]]:
    """Return name, x and y of all crates. Each drives back and forth."""
    return [
        (f"crate_{k}", 6 + 2 * (k % 5) + math.sin(time_s + k), 3.0 * (k // 5) - 5)
        for k in range(CRATES)
    ]


def simulate(domain: int) -> None:
    """Publish the clock and poses until the process is killed."""
    from tests.simulators import clock, transforms

    from lidarlive.playback.dds import Network, RosPublisher

    with RosPublisher(Network(domain=domain)) as publisher:
        begin_s = time.monotonic()
        step = 0
        while True:
            time_s = step / 1000
            time.sleep(max(0.0, begin_s + time_s - time.monotonic()))
            if step % 10 == 0:
                yaw_deg = 20 * math.sin(time_s)
                frames = [("robot", "yard", (0.3 * math.sin(time_s), 0, 1), yaw_deg)]
                frames += [(name, "yard", (x, y, 0.5), 0.0) for name, x, y in positions(time_s)]
                publisher.publish(transforms(time_s, frames))
            publisher.publish(clock(time_s))
            step += 1


def measure(model: str, domain: int, seconds: float) -> dict[str, Any]:
    """Run the node and the simulator, and return the CPU share and the delays."""
    environment = os.environ | {
        "ROS_DOMAIN_ID": str(domain),
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
    }
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        models = "".join(_MODEL.format(name=n, x=x, y=y) for n, x, y in positions(0))
        (folder / "yard.sdf").write_text(_WORLD.format(models=models))
        mount = "mount: {link: robot/lidar}"
        (folder / "sensors.yaml").write_text(f"sensors: {{top: {{model: {model}, {mount}}}}}\n")
        command = [sys.executable, "-m", "lidarpool", "follow", "yard.sdf", "--as", "ros2",
                   "--sensors", "sensors.yaml"]  # fmt: skip
        node = subprocess.Popen(
            command, cwd=folder, env=environment, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
        assert node.stdout is not None
        node.stdout.readline()
        simulator = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.follow", "--simulate", str(domain)], env=environment
        )
        try:
            time.sleep(_START_S)
            process = psutil.Process(node.pid)
            before = process.cpu_times()
            begin_s = time.monotonic()
            time.sleep(seconds)
            after = process.cpu_times()
            elapsed_s = time.monotonic() - begin_s
        finally:
            simulator.kill()
            simulator.wait()
            node.send_signal(signal.SIGINT)
        _, errors = node.communicate(timeout=60)
    cpu_s = after.user + after.system - before.user - before.system
    return {"cpu_share": round(cpu_s / elapsed_s, 3), "summary": errors.strip().splitlines()[-1]}


if __name__ == "__main__":
    main()
