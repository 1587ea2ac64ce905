"""A client of Foxglove's WebSocket protocol, which shares no code with what serves it.

Messages are decoded by the descriptors that the server advertises, with a decoder of protobuf's
wire format: https://protobuf.dev/programming-guides/encoding and
https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md.
"""

from __future__ import annotations

import base64
import json
import struct
import time
from collections import defaultdict

import numpy as np
from websockets.sync.client import connect

DOUBLE, FLOAT, FIXED64, FIXED32, BOOL, STRING, MESSAGE, BYTES, ENUM = 1, 2, 6, 7, 8, 9, 11, 12, 14
REPEATED = 3
VARINT, EIGHT_BYTES, DELIMITED, FOUR_BYTES = 0, 1, 2, 5
FIXED = {DOUBLE: "<d", FLOAT: "<f", FIXED64: "<Q", FIXED32: "<I"}
# Types of packed fields of foxglove.PointCloud.
NUMBER_TYPES = {1: "u1", 2: "i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<f4", 8: "<f8"}


def varint(data, offset):
    value = shift = 0
    while True:
        byte = data[offset]
        offset += 1
        value |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            return value, offset


def raw_fields(data):
    """Yield number, wire type and value of the fields of a message."""
    offset = 0
    while offset < len(data):
        key, offset = varint(data, offset)
        wire = key & 7
        if wire == VARINT:
            value, offset = varint(data, offset)
        else:
            size = {EIGHT_BYTES: 8, FOUR_BYTES: 4}.get(wire)
            if size is None:
                size, offset = varint(data, offset)
            value = bytes(data[offset : offset + size])
            offset += size
        yield key >> 3, wire, value


class Schemas:
    """Decodes messages by a set of file descriptors."""

    def __init__(self, descriptors):
        self.messages = {}  # {name: {number: (name, type, name of type, whether repeated)}}
        for _, _, file in raw_fields(descriptors):
            content = defaultdict(list)
            for number, _, value in raw_fields(file):
                content[number].append(value)
            package = content[2][0].decode()
            for message in content[4]:
                self.add(f".{package}", message)

    def add(self, scope, data):
        content = defaultdict(list)
        for number, _, value in raw_fields(data):
            content[number].append(value)
        name = f"{scope}.{content[1][0].decode()}"
        fields = {}
        for field in content[2]:
            parts = {number: value for number, _, value in raw_fields(field)}
            type_name = parts.get(6, b"").decode()
            fields[parts[3]] = parts[1].decode(), parts[5], type_name, parts[4] == REPEATED
        self.messages[name] = fields
        for nested in content[3]:
            self.add(name, nested)

    def decode(self, name, data):
        message = {}
        for number, wire, value in raw_fields(data):
            field, kind, type_name, repeated = self.messages[name][number]
            if kind == MESSAGE:
                values = [self.decode(type_name, value)]
            elif kind in FIXED:
                values = [number for (number,) in struct.iter_unpack(FIXED[kind], value)]
            elif kind == STRING:
                values = [value.decode()]
            elif wire == DELIMITED and kind != BYTES:
                raise AssertionError("packed varints are not expected")
            else:
                values = [value]
            if repeated:
                message.setdefault(field, []).extend(values)
            else:
                (message[field],) = values
        return message


class FoxgloveClient:
    """Subscribes to all topics, and keeps what comes; a context manager."""

    def __init__(self, port, protocol="foxglove.sdk.v1"):
        self._connection = connect(
            f"ws://127.0.0.1:{port}",
            subprotocols=[protocol],
            max_size=None,
            proxy=None,
            close_timeout=0.2,
        )
        self.socket = self._connection.__enter__()
        self.channels = {}  # {id: (topic, name of the schema, schemas)}
        self.messages = []  # (topic, time in nanoseconds, message)
        self.times_ns = []  # of the server's clock
        self.statuses = []
        self.server = None

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self._connection.__exit__(*error)

    def receive(self, is_complete=lambda client: False, timeout_s=10):
        """Receive until a condition holds, or nothing comes for a time."""
        give_up_at = time.monotonic() + timeout_s
        while not is_complete(self) and time.monotonic() < give_up_at:
            try:
                self.take(self.socket.recv(timeout=timeout_s))
            except TimeoutError:
                break
        return self

    def settle(self):
        """Wait until the server has taken all subscriptions: it answers a malformed one after."""
        count = len(self.statuses)
        self.socket.send('{"op": "subscribe"}')
        return self.receive(lambda client: len(client.statuses) > count)

    def take(self, data):
        if isinstance(data, str):
            message = json.loads(data)
            if message["op"] == "serverInfo":
                self.server = message
            elif message["op"] == "advertise":
                for channel in message["channels"]:
                    self.subscribe(channel)
            elif message["op"] == "status":
                self.statuses.append(message["message"])
            return
        opcode = data[0]
        if opcode == 2:
            self.times_ns.append(struct.unpack_from("<Q", data, 1)[0])
            return
        assert opcode == 1
        channel, time_ns = struct.unpack_from("<IQ", data, 1)
        topic, name, schemas = self.channels[channel]
        self.messages.append((topic, time_ns, schemas.decode(f".{name}", data[13:])))

    def subscribe(self, channel):
        assert channel["encoding"] == channel["schemaEncoding"] == "protobuf"
        schemas = Schemas(base64.b64decode(channel["schema"]))
        self.channels[channel["id"]] = channel["topic"], channel["schemaName"], schemas
        wanted = [{"id": channel["id"], "channelId": channel["id"]}]
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def of(self, topic):
        return [message for name, _, message in self.messages if name == topic]

    @property
    def topics(self):
        return {topic for topic, *_ in self.channels.values()}


def records(cloud):
    """Return the points of a foxglove.PointCloud by its own fields."""
    fields = cloud["fields"]
    kind = np.dtype(
        {
            "names": [field["name"] for field in fields],
            "formats": [NUMBER_TYPES[field["type"]] for field in fields],
            "offsets": [field.get("offset", 0) for field in fields],
            "itemsize": cloud["point_stride"],
        }
    )
    return np.frombuffer(cloud["data"], kind)


def numbers(message, names):
    """Return numbers of a message; proto3 leaves zeros out."""
    return np.array([message.get(name, 0.0) for name in names])


def stamp_ns(message):
    """Return the nanoseconds of a google.protobuf.Timestamp."""
    return message.get("seconds", 0) * 1_000_000_000 + message.get("nanos", 0)
