"""Send sweeps to Foxglove, which connects to a WebSocket server in this process."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from typing import Any

import foxglove
import numpy as np
from foxglove import channels, messages
from foxglove.websocket import Capability, ChannelView, Client, ServerListener

from lidarfiles.clouds.frame_names import WORLD
from lidarfiles.clouds.shown_sweeps import ActorBoxes, FramePose, ShownSweep, Surface, Surroundings
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import AnyArray, Bytes, Floats, Floats32, Records

from .viewer import LOOPBACK, Address, Viewer

PORT = 8765  # default port of Foxglove
# Maximum number of pending messages per client. The oldest messages are dropped first, which bounds
# the memory that a slow client requires.
BACKLOG = 64
_NUMBER_TYPES = {
    "u1": messages.PackedElementFieldNumericType.Uint8,
    "i1": messages.PackedElementFieldNumericType.Int8,
    "u2": messages.PackedElementFieldNumericType.Uint16,
    "i2": messages.PackedElementFieldNumericType.Int16,
    "u4": messages.PackedElementFieldNumericType.Uint32,
    "i4": messages.PackedElementFieldNumericType.Int32,
    "f4": messages.PackedElementFieldNumericType.Float32,
    "f8": messages.PackedElementFieldNumericType.Float64,
}
_FRAMES = "/tf"
_ACTORS = "/actors"
_SCENE = "/scene"
_TRAJECTORIES = "/trajectories"
_PATH = "/path"
_SCENE_ALPHA = 0.4  # so that points on and behind surfaces are visible
_GRAY = messages.Color(r=0.6, g=0.6, b=0.6, a=_SCENE_ALPHA)
_ORANGE = messages.Color(r=1.0, g=0.6, b=0.0, a=0.4)
_WHITE = messages.Color(r=1.0, g=1.0, b=1.0, a=1.0)
_BLUE = messages.Color(r=0.2, g=0.6, b=1.0, a=1.0)
_GREEN = messages.Color(r=0.1, g=0.8, b=0.3, a=1.0)
_LINE_PIXELS = 2.0
_TEXT_PIXELS = 12.0
_COLOR_BITS = 4  # bits per color channel of the scene
_UNIT = messages.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)


class FoxgloveServer(Viewer):
    """WebSocket server for Foxglove, which listens only on the loopback interface.

    The server of the SDK has no token and does not check `Origin`. Every program that can connect
    can therefore read all messages, including scripts of any website in a browser on this machine.

    The topics are `/NAME/points` for each sensor or `/points`, `/tf`, `/actors`, `/scene`,
    `/trajectories` and `/path`, with Foxglove schemas. Late subscribers receive the latest message
    of a topic.

    Parameters
    ----------
    to
        Address and port to listen on, as ADDRESS:PORT. By default, the port is 8765 on 127.0.0.1,
        or another port if it is in use.
    title
        Name of the data source in Foxglove.
    sends_time
        Whether the clock of Foxglove shows the times of the sweeps, which must be sent in order. By
        default, it shows the time of the computer.

    Raises
    ------
    LidarError
        If the address cannot be used, or if it can be reached from other machines.
    """

    def __init__(
        self, to: str | None = None, title: str = "lidarpool", *, sends_time: bool = False
    ) -> None:
        address = Address.choose(to, PORT)
        if not address.is_loopback:
            raise LidarError(
                "The Foxglove server has no password, so it can only listen on this machine "
                f"and not on {address}. Use 127.0.0.1 and forward the port: ssh -L "
                f"{address.port}:{LOOPBACK}:{address.port} user@machine."
            )
        # The server logs malformed client requests as warnings.
        logging.getLogger("foxglove").setLevel(logging.CRITICAL)
        self._context = foxglove.Context()
        self._channels: dict[str, Any] = {}  # by topic
        self._latest: dict[str, tuple[Any, int]] = {}  # message and time in nanoseconds, by topic
        self._frames: dict[str, Any] = {}  # latest transform by frame name
        self._sends_time = sends_time
        self._start_ns = 0  # start of the latest sweep
        try:
            self._server = foxglove.start_server(
                name=title,
                host=address.host,
                port=address.port,
                capabilities=[Capability.Time] if sends_time else [],
                server_listener=_SubscriptionListener(self._send_again),
                context=self._context,
                message_backlog_size=BACKLOG,
            )
        except RuntimeError as error:
            raise LidarError(f"The Foxglove server cannot listen on {address}: {error}") from error
        self.address = Address(address.host, self._server.port)
        self.description = f"Foxglove is available at {self.link} or {self.desktop_link}"

    @property
    def link(self) -> str:
        """Address that opens Foxglove in a browser and connects it to this server."""
        return f"https://app.foxglove.dev/?{self._source}"

    @property
    def desktop_link(self) -> str:
        """Address that opens the Foxglove desktop application and connects it to this server."""
        return f"foxglove://open?{self._source}"

    @property
    def _source(self) -> str:
        return f"ds=foxglove-websocket&ds.url=ws://{self.address}"

    def show_surroundings(self, surroundings: Surroundings) -> None:
        """Replace the scene, trajectories and planned path."""
        self._clear()
        self._channel(_FRAMES, channels.FrameTransformsChannel)
        for topic in surroundings.topics:  # so that clients can subscribe before the first sweep
            self._channel(topic, channels.PointCloudChannel)
        if surroundings.has_actors:
            self._channel(_ACTORS, channels.SceneUpdateChannel)
        if surroundings.surface is not None:
            triangles = [*_triangles(surroundings.surface)]
            self._send_entities(_SCENE, [_entity("scene", triangles=triangles)])
        if surroundings.trajectories:
            entities = [
                _entity(name, lines=[_line(positions, _BLUE)])
                for name, positions in surroundings.trajectories.items()
            ]
            self._send_entities(_TRAJECTORIES, entities)
        if surroundings.path is not None:
            self.show_path(surroundings.path)

    def show_path(self, path: Floats) -> None:
        """Show a planned path in world coordinates, in meters.

        The path has shape (w, 3).
        """
        self._send_entities(_PATH, [_entity("path", lines=[_line(path, _GREEN)])])

    def show_sweep(self, shown: ShownSweep) -> None:
        """Show a sweep's points, frames and actor boxes without waiting for clients."""
        self._start_ns = shown.start_ns
        if self._sends_time:
            self._server.broadcast_time(shown.start_ns)
        stamp = _timestamp(shown.start_ns)
        transforms = {t.name: _transform(t, stamp) for t in shown.transforms}
        frames = messages.FrameTransforms(transforms=[*transforms.values()])
        self._send(_FRAMES, channels.FrameTransformsChannel, frames, shown.start_ns)
        self._frames |= transforms
        all_frames = messages.FrameTransforms(transforms=[*self._frames.values()])
        self._latest[_FRAMES] = all_frames, shown.start_ns
        self._send(shown.topic, channels.PointCloudChannel, _point_cloud(shown), shown.start_ns)
        if shown.boxes is not None:
            actors = _actors(shown.boxes, stamp)
            self._send(_ACTORS, channels.SceneUpdateChannel, actors, shown.start_ns)

    def close(self) -> None:
        """Disconnect all clients."""
        self._server.stop()

    def _clear(self) -> None:
        """Delete all entities and frames."""
        everything = messages.SceneEntityDeletion(type=messages.SceneEntityDeletionType.All)
        for topic in (_SCENE, _TRAJECTORIES, _PATH, _ACTORS):
            if topic in self._latest:
                update = messages.SceneUpdate(deletions=[everything])
                self._send(topic, channels.SceneUpdateChannel, update, self._start_ns)
        self._frames = {}

    def _send_entities(self, topic: str, entities: list[Any]) -> None:
        update = messages.SceneUpdate(entities=entities)
        self._send(topic, channels.SceneUpdateChannel, update, self._start_ns)

    def _send(self, topic: str, kind: Callable[..., Any], message: Any, time_ns: int) -> None:
        channel = self._channel(topic, kind)
        self._latest[topic] = message, time_ns
        channel.log(message, log_time=time_ns)

    def _channel(self, topic: str, kind: Callable[..., Any]) -> Any:
        if topic not in self._channels:
            self._channels[topic] = kind(topic, context=self._context)
        return self._channels[topic]

    def _send_again(self, topic: str) -> None:
        if topic in self._latest:
            message, time_ns = self._latest[topic]
            self._channels[topic].log(message, log_time=time_ns)


class _SubscriptionListener(ServerListener):
    """Listener that calls a function with the topic of each new subscription."""

    def __init__(self, subscribed: Callable[[str], None]) -> None:
        self._subscribed = subscribed

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        self._subscribed(channel.topic)


def packed_points(shown: ShownSweep) -> Records:
    """Pack a sweep's points into records.

    Each record contains all columns, and x, y and z as float32.
    """
    values: dict[str, AnyArray] = dict(zip("xyz", shown.positions.T, strict=True))
    values |= shown.columns
    kinds = [(name, column.dtype.newbyteorder("<")) for name, column in values.items()]
    rows = np.empty(len(shown.positions), kinds)
    for name, column in values.items():
        rows[name] = column
    return rows


def _point_cloud(shown: ShownSweep) -> Any:
    """Convert a sweep to a message, whose timestamp is from the clock of the sensor."""
    rows = packed_points(shown)
    fields = [
        messages.PackedElementField(name=name, offset=offset, type=_NUMBER_TYPES[kind.str[1:]])
        for name, (kind, offset, *_) in (rows.dtype.fields or {}).items()
    ]
    return messages.PointCloud(
        timestamp=_timestamp(shown.stamp_ns),
        frame_id=shown.frame,
        pose=messages.Pose(position=_vector(np.zeros(3)), orientation=_UNIT),
        point_stride=rows.dtype.itemsize,
        fields=fields,
        data=rows.tobytes(),
    )


def _transform(transform: FramePose, stamp: Any) -> Any:
    x, y, z, w = transform.quaternion.tolist()
    return messages.FrameTransform(
        timestamp=stamp,
        parent_frame_id=transform.parent,
        child_frame_id=transform.name,
        translation=_vector(transform.position),
        rotation=messages.Quaternion(x=x, y=y, z=z, w=w),
    )


def _actors(boxes: ActorBoxes, stamp: Any) -> Any:
    """Return the boxes of present actors, and messages that delete the boxes of other actors."""
    entities = []
    deletions = []
    for number, name in enumerate(boxes.names):
        if not boxes.present[number]:
            deletions.append(messages.SceneEntityDeletion(timestamp=stamp, id=name))
            continue
        pose = _pose(boxes.centers[number], boxes.quaternions[number])
        size = _vector(boxes.sizes[number])
        cube = messages.CubePrimitive(pose=pose, size=size, color=_ORANGE)
        above = boxes.centers[number] + [0, 0, boxes.sizes[number, 2] / 2 + 0.5]
        text = messages.TextPrimitive(
            pose=_pose(above),
            billboard=True,
            font_size=_TEXT_PIXELS,
            scale_invariant=True,
            color=_WHITE,
            text=name,
        )
        details = {"type": boxes.types[number], "points": f"{boxes.points[number]}"}
        metadata = [messages.KeyValuePair(key=key, value=value) for key, value in details.items()]
        entities.append(
            _entity(name, timestamp=stamp, cubes=[cube], texts=[text], metadata=metadata)
        )
    return messages.SceneUpdate(deletions=deletions, entities=entities)


def _triangles(surface: Surface) -> Iterable[Any]:
    """Yield the triangles of a scene, grouped by color."""
    pose = _pose(surface.origin)
    if surface.colors is None:
        yield _triangle_list(surface, slice(None), pose, _GRAY)
        return
    step = 8 - _COLOR_BITS
    levels = surface.colors >> step
    colors, numbers = np.unique(levels, axis=0, return_inverse=True)
    for number, level in enumerate(colors):
        yield _triangle_list(surface, numbers.ravel() == number, pose, _color(level))


def _color(level: Bytes) -> Any:
    red, green, blue = (level / (2**_COLOR_BITS - 1)).tolist()
    return messages.Color(r=red, g=green, b=blue, a=_SCENE_ALPHA)


def _triangle_list(surface: Surface, face_indices: Any, pose: Any, color: Any) -> Any:
    used, indices = np.unique(surface.faces[face_indices], return_inverse=True)
    return messages.TriangleListPrimitive(
        pose=pose,
        points=_points(surface.vertices[used]),
        color=color,
        indices=indices.ravel().tolist(),
    )


def _line(positions: Floats, color: Any) -> Any:
    """Return a line through the given positions, relative to the first position.

    The positions have shape (k, 3).
    """
    return messages.LinePrimitive(
        type=messages.LinePrimitiveLineType.LineStrip,
        pose=_pose(positions[0]),
        thickness=_LINE_PIXELS,
        scale_invariant=True,
        points=_points(positions - positions[0]),
        color=color,
    )


def _entity(name: str, **primitives: Any) -> Any:
    """Return an entity in world coordinates, which replaces any entity of the same name."""
    return messages.SceneEntity(id=name, frame_id=WORLD, frame_locked=True, **primitives)


def _points(positions: Floats | Floats32) -> list[Any]:
    return [messages.Point3(x=x, y=y, z=z) for x, y, z in positions.tolist()]


def _pose(position: Floats, quaternion: Floats | None = None) -> Any:
    orientation = _UNIT
    if quaternion is not None:
        x, y, z, w = quaternion.tolist()
        orientation = messages.Quaternion(x=x, y=y, z=z, w=w)
    return messages.Pose(position=_vector(position), orientation=orientation)


def _vector(values: Floats) -> Any:
    x, y, z = values.tolist()
    return messages.Vector3(x=x, y=y, z=z)


def _timestamp(time_ns: int) -> Any:
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    return messages.Timestamp(sec=seconds, nsec=nanoseconds)
