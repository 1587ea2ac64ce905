"""Methods of the sensor service, independent of the server that calls them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import grpc
from google.protobuf.message import DecodeError

from lidarsim._version import __version__
from lidarsim.errors import LidarError
from lidarsim.words import plural, printable

from .conversion import points_message, sweep_request, trajectory_message
from .messages import METHODS, SERVICE, message_class
from .served_scene import SensorPoints, ServedScene

MAX_POINTS = 2_000_000  # maximum number of points in a reply; as lists and buffers, 64 MB
_MAX_SWEEPS = 16  # maximum number of sweeps in an aggregated request
_API_VERSION = {"major": 0, "minor": 54, "patch": 0}  # of the protocol that was implemented
_CAMERA_METHODS = ("render_rgb", "batch_render_rgb")
_NO_CAMERAS = "lidarpool simulates lidars and has no cameras. Call render_lidar."
_MAX_NOTES = 20  # maximum number of notes about ignored objects

Context = Any  # grpc.ServicerContext


class RequestError(LidarError):
    """A request that is refused with a status code other than INVALID_ARGUMENT."""

    def __init__(self, code: grpc.StatusCode, message: str) -> None:
        super().__init__(message)
        self.code = code


class SensorService:
    """Service that answers requests from simulators.

    Several threads can call the service.

    Parameters
    ----------
    scene
        The scene and its sensors.
    report
        Function that shows a note to the user of the server.
    ignores_unknown
        Whether objects that are not in the scene are ignored. Otherwise, the request is refused.
    """

    def __init__(
        self, scene: ServedScene, report: Callable[[str], None], *, ignores_unknown: bool = False
    ) -> None:
        self._scene = scene
        self._report = report
        self._ignores_unknown = ignores_unknown
        self._lock = threading.Lock()  # for the following attributes
        self._ignored: set[str] = set()
        self._sweeps = 0
        self._points = 0
        self._refused = 0

    @property
    def summary(self) -> str:
        """Number of sweeps, points and refused requests."""
        with self._lock:
            refused = f" {plural(self._refused, 'request')} refused." if self._refused else ""
            return (
                f"{plural(self._sweeps, 'sweep')} with {plural(self._points, 'point')} simulated."
                f"{refused}"
            )

    def handler(self) -> Any:
        """Return the handler of all methods, for `grpc.Server.add_generic_rpc_handlers`."""
        handlers = {name: self._method_handler(name) for name in METHODS}
        refuse = grpc.unary_unary_rpc_method_handler(_refuse_cameras)
        handlers |= dict.fromkeys(_CAMERA_METHODS, refuse)
        return grpc.method_handlers_generic_handler(SERVICE, handlers)

    def _method_handler(self, name: str) -> Any:
        request_class, reply_class = map(message_class, METHODS[name])
        method = getattr(self, f"_{name}")

        def answer(data: bytes, context: Context) -> Any:
            # The messages are parsed here, because grpc prints a traceback if a parser fails.
            try:
                request = request_class.FromString(data)
                return method(request, context)
            except DecodeError:
                code, message = grpc.StatusCode.INVALID_ARGUMENT, "The request cannot be decoded."
            except RequestError as error:
                code, message = error.code, str(error)
            except LidarError as error:
                code, message = grpc.StatusCode.INVALID_ARGUMENT, str(error)
            with self._lock:
                self._refused += 1
            return context.abort(code, " ".join(message.split()))  # raises an exception

        return grpc.unary_unary_rpc_method_handler(
            answer, response_serializer=reply_class.SerializeToString
        )

    def _render_lidar(self, request: Any, context: Context) -> Any:
        return points_message(self._simulate(request, context, MAX_POINTS))

    def _render_aggregated(self, request: Any, context: Context) -> Any:
        if request.rgb_requests:
            raise RequestError(grpc.StatusCode.UNIMPLEMENTED, _NO_CAMERAS)
        if len(request.lidar_requests) > _MAX_SWEEPS:
            raise LidarError(
                f"lidar_requests has {len(request.lidar_requests)} entries. The limit is "
                f"{_MAX_SWEEPS}."
            )
        replies = []
        remaining = MAX_POINTS
        for lidar_request in request.lidar_requests:
            points = self._simulate(lidar_request, context, remaining)
            remaining -= len(points.intensities)
            replies.append(points_message(points))
        return message_class("AggregatedRenderReturn")(lidar_returns=replies)

    def _simulate(self, request: Any, context: Context, max_points: int) -> SensorPoints:
        """Simulate a sweep, and count it."""
        self._check_scene(request.scene_id)
        device = request.lidar_config.lidar_type
        sensor = self._scene.sensors.get(device)
        if sensor is None:
            raise LidarError(f"lidar_type {device} is unknown.")
        sweep = sweep_request(request)
        if self._ignores_unknown:
            known = {name: p for name, p in sweep.objects.items() if name in self._scene.actors}
            self._note_ignored(sweep.objects.keys() - known.keys())
            sweep = replace(sweep, objects=known)
        points = sensor.simulate(sweep, context.is_active)
        if points is None:
            raise RequestError(grpc.StatusCode.CANCELLED, "The client has canceled the request.")
        count = len(points.intensities)
        if count > max_points:
            raise RequestError(
                grpc.StatusCode.RESOURCE_EXHAUSTED,
                f"The sweep has {count:,} points, but the reply can only hold {max_points:,}. Use "
                "a sensor with fewer rays or returns.",
            )
        with self._lock:
            self._sweeps += 1
            self._points += count
        return points

    def _note_ignored(self, names: set[str]) -> None:
        """Show a note about each object that is ignored for the first time."""
        with self._lock:
            new = sorted(names - self._ignored)[: _MAX_NOTES - len(self._ignored)]
            self._ignored.update(new)
        for name in new:
            self._report(f"The scene has no actor {printable(name)!r}, so it is ignored.")

    def _check_scene(self, name: str) -> None:
        if name != self._scene.name:
            raise RequestError(
                grpc.StatusCode.NOT_FOUND,
                f"The scene {printable(name)!r} is not served here. The available scene is "
                f"{self._scene.name!r}.",
            )

    def _get_version(self, request: Any, context: Context) -> Any:
        version = message_class("ApiVersion")(**_API_VERSION)
        return message_class("VersionId")(
            version_id=f"lidarpool {__version__}", grpc_api_version=version
        )

    def _get_available_scenes(self, request: Any, context: Context) -> Any:
        return message_class("AvailableScenesReturn")(scene_ids=[self._scene.name])

    def _get_loaded_scenes(self, request: Any, context: Context) -> Any:
        entry = message_class("LoadedSceneEntry")(
            scene_id=self._scene.name, loaded_instance_count=1, reusable_instance_count=1
        )
        return message_class("LoadedScenesReturn")(scenes=[entry], loaded_instance_capacity=1)

    def _get_available_cameras(self, request: Any, context: Context) -> Any:
        self._check_scene(request.scene_id)
        return message_class("Empty")()  # no cameras

    def _get_available_trajectories(self, request: Any, context: Context) -> Any:
        self._check_scene(request.scene_id)
        reply = message_class("AvailableTrajectoriesReturn")()
        if self._scene.drive is not None:
            trajectory = trajectory_message(self._scene.drive)
            reply.available_trajectories.add(trajectory=trajectory)
        return reply

    def _get_available_ego_masks(self, request: Any, context: Context) -> Any:
        return message_class("Empty")()  # no cameras


def _refuse_cameras(request: bytes, context: Context) -> None:
    context.abort(grpc.StatusCode.UNIMPLEMENTED, _NO_CAMERAS)
