"""The `lidarpool serve` command, which answers sweep requests from simulators."""

from __future__ import annotations

from pathlib import Path

import click

from lidarsim.environment.extras import require_package
from lidarsim.errors import LidarError

from . import completion
from . import shared_options as options
from .first_step import print_first_step

_EXTRA = "serve"
_DEFAULT_MODELS = {"PANDAR128": "hesai/pandar128", "AT128": "hesai/at128"}


def _require_grpc() -> None:
    for package in ("grpc", "google.protobuf"):
        require_package(package, _EXTRA, "The sensor service")


@click.command()
@click.argument("scene", metavar="SCENE", type=click.Path(path_type=Path), required=False)
@click.option(
    "--sensor",
    "models",
    metavar="[DEVICE=]MODEL",
    multiple=True,
    shell_complete=completion.sensors,
    help="Sensor model or sensor file for the device that a request names, PANDAR128 or AT128; "
    "without DEVICE, for both (default: the model of the same name).",
)
@click.option(
    "--rate-hz",
    type=options.Number(0, 1000, min_open=True),
    metavar="RATE",
    help="Sweeps per second of the sensors (default: from the models).",
)
@click.option(
    "--scene-id",
    "name",
    metavar="NAME",
    help="Name of the scene in requests (default: the name of SCENE).",
)
@click.option(
    "--listen",
    metavar="ADDRESS:PORT",
    help="Address to listen on (default: 127.0.0.1 and port 50051, or the next free port).",
)
@options.path(
    "--token-file",
    help="File with a token that every request must contain. Required to listen on an address that "
    "other machines can reach.",
)
@options.flag(
    "--ignore-unknown-objects",
    help="Ignore moving objects that are not in the scene (default: refuse the request).",
)
@options.backend
@options.new_file("--proto", help="Write the protocol to FILE (.proto) and exit.")
def serve(
    *,
    scene: Path | None,
    models: tuple[str, ...],
    rate_hz: float | None,
    name: str | None,
    listen: str | None,
    token_file: Path | None,
    ignore_unknown_objects: bool,
    backend: str | None,
    proto: Path | None,
) -> None:
    """Simulate sweeps for simulators that request them over gRPC.

    SCENE is a scenario, a mesh file, or a folder that lidarpool twin has written. The service is
    compatible with the SensorsimService of AlpaSim. A request contains the poses of the sensor and
    of the moving objects at the start and the end of a sweep. The reply contains the points in the
    sensor frame at the end of the sweep. The service runs until Ctrl-C is pressed.

    \b
    Examples:
      lidarpool serve twin
      lidarpool serve drive.yaml --sensor ouster/os1-128 --listen 127.0.0.1:50052
      lidarpool serve twin --sensor PANDAR128=hesai/pandar128 --sensor AT128=my-sensor.yaml
      lidarpool serve twin --listen 0.0.0.0:50051 --token-file token.txt
      lidarpool serve --proto sensorsim.proto
    """  # noqa: D301 - Click requires the character \b
    _require_grpc()
    if proto is not None:
        _write_proto(proto)
        return
    if scene is None:
        raise click.UsageError("Missing argument 'SCENE'.")
    print_first_step("reading the scene")
    from lidarfiles.processes.freed_memory import keep_freed_memory
    from lidarlive.serving.messages import DEVICES
    from lidarlive.serving.served_scene import load_served_scene
    from lidarlive.serving.server import Endpoint, SensorServer
    from lidarlive.serving.service import SensorService

    from .terminal import Terminal

    keep_freed_memory()
    report = Terminal().report
    endpoint = Endpoint.choose(listen, token_file)
    chosen = {DEVICES[device]: model for device, model in _models(models).items()}
    served = load_served_scene(scene, chosen, report, name=name, rate_hz=rate_hz, backend=backend)
    service = SensorService(served, report, ignores_unknown=ignore_unknown_objects)
    server = SensorServer(service, endpoint)
    with options.summary_at_end(lambda: service.summary), server:
        sensors = ", ".join(
            f"{device} is {served.sensors[number].name}" for device, number in DEVICES.items()
        )
        click.echo(
            f"ready: scene {served.name} on {server.address}, {sensors}. Press Ctrl-C to stop."
        )
        server.wait()


def _write_proto(path: Path) -> None:
    from lidarlive.serving.messages import proto_text

    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(proto_text())
    except FileExistsError as error:
        raise LidarError(f"{path} already exists. Remove it, or specify another file.") from error
    click.echo(str(path))


def _models(texts: tuple[str, ...]) -> dict[str, str]:
    """Return the model of each device, which is the default unless an option replaces it.

    Raise LidarError if a device is unknown or has several models.
    """
    models: dict[str, str] = {}
    for text in texts:
        device, has_device, model = text.partition("=")
        devices = [device] if has_device else [*_DEFAULT_MODELS]
        if has_device and device not in _DEFAULT_MODELS:
            raise LidarError(
                f"`--sensor` names the unknown device {device!r}. Available devices: "
                f"{', '.join(_DEFAULT_MODELS)}."
            )
        for key in devices:
            if key in models:
                raise LidarError(f"`--sensor` names two models for {key}. Specify one of them.")
            models[key] = model if has_device else text
    return _DEFAULT_MODELS | models
