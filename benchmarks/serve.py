"""Measure the CPU time of `lidarpool serve` per request.

    python -m benchmarks.serve [--sweeps 30]

The service runs in its own process, in a city of 100,000 triangles. The client drives through the
city at 10 m/s among 20 moving cars, and requests one sweep after another. For each sensor, the CPU
time of the service is compared with the CPU time of the same sweeps without a server.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import psutil
import yaml

from lidarlive.serving.conversion import sweep_request
from lidarlive.serving.messages import SERVICE, message_class
from lidarlive.serving.served_scene import load_served_scene

SENSORS = ("velodyne/vlp16", "hesai/at128", "hesai/pandar128")
CARS = 20
_WARM = 5  # warm-up requests, which are not measured
_SWEEP_US = 100_000
_LIMIT = [("grpc.max_receive_message_length", 1 << 27)]


def main() -> None:
    """Measure each sensor, and print one line per sensor."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sweeps", type=int, default=30, help="measured requests per sensor")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        scene = scenario_of(Path(folder))
        for model in SENSORS:
            print(json.dumps({"sensor": model, **measure(scene, model, arguments.sweeps)}))


def scenario_of(folder: Path) -> Path:
    """Write the scene and its scenario, and return the path of the scenario."""
    command = [sys.executable, "-m", "lidarpool", "scene", "city", str(folder / "city.glb")]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    points = [{"time_s": 0, "position": [0, 0, 0]}, {"time_s": 9, "position": [9, 0, 0]}]
    cars = [
        {"name": f"car {k}", "box": [4.5, 1.8, 1.5], "trajectory": {"points": points}}
        for k in range(CARS)
    ]
    path = folder / "city.yaml"
    path.write_text(yaml.safe_dump({"scene": "city.glb", "poses": [[0, 0, 2]], "actors": cars}))
    return path


def request_of(number: int) -> Any:
    """Return the request for a sweep of the drive."""
    x = -40 + number
    return message_class("LidarRenderRequest")(
        scene_id="city",
        frame_start_us=number * _SWEEP_US,
        frame_end_us=(number + 1) * _SWEEP_US,
        sensor_pose=_pair((x, -3, 1.9), (x + 1, -3, 1.9)),
        dynamic_objects=[
            {
                "track_id": f"car {k}",
                "pose_pair": _pair((x + 6 * k - 50, 3, 0.75), (x + 6 * k - 51, 3, 0.75)),
            }
            for k in range(CARS)
        ],
    )


def _pair(start: Any, end: Any) -> dict[str, Any]:
    poses = [
        {"vec": dict(zip("xyz", position, strict=True)), "quat": {"w": 1}}
        for position in (start, end)
    ]
    return {"start_pose": poses[0], "end_pose": poses[1]}


def measure(scene: Path, model: str, count: int) -> dict[str, Any]:
    """Return the times per request and the size of the replies."""
    cpu_s = []
    wall_s = []
    points = []
    with service(scene, model) as (process, address):
        channel = grpc.insecure_channel(address, _LIMIT)
        call = channel.unary_unary(f"/{SERVICE}/render_lidar")
        for number in range(_WARM + count):
            data = request_of(number).SerializeToString()
            before = process.cpu_times()
            began = time.perf_counter()
            reply = call(data)
            wall_s.append(time.perf_counter() - began)
            after = process.cpu_times()
            cpu_s.append(after.user + after.system - before.user - before.system)
            points.append(message_class("LidarRenderReturn").FromString(reply).num_points)
    return {
        "points": int(np.mean(points[_WARM:])),
        "reply_mb": round(32e-6 * float(np.mean(points[_WARM:])), 2),
        "service_cpu_ms": round(1e3 * float(np.mean(cpu_s[_WARM:])), 1),
        "wall_ms": round(1e3 * float(np.median(wall_s[_WARM:])), 1),
        "local_cpu_ms": round(1e3 * local_cpu_s(scene, model, count), 1),
    }


@contextmanager
def service(scene: Path, model: str) -> Iterator[tuple[psutil.Process, str]]:
    """Run the service, and yield its process and its address."""
    command = [sys.executable, "-m", "lidarpool", "serve", str(scene), "--sensor", model]
    command += ["--listen", "127.0.0.1:0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        try:
            yield psutil.Process(process.pid), line.split()[4].rstrip(",")
        finally:
            process.terminate()


def local_cpu_s(scene: Path, model: str, count: int) -> float:
    """Return the CPU time per sweep without the service."""
    sensor = load_served_scene(scene, {0: model}, lambda note: None).sensors[0]
    for number in range(_WARM + count):
        if number == _WARM:
            began_s = time.process_time()
        sensor.simulate(sweep_request(request_of(number)))
    return (time.process_time() - began_s) / count


if __name__ == "__main__":
    main()
