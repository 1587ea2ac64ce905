"""Messages of the sensor service.

The messages are compatible on the wire with those of `SensorsimService` in AlpaSim. Only the field
numbers and types matter for that, so fields that a lidar does not need are not declared. They have
a separate descriptor pool, so that a process can also import stubs that protoc has generated.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

from google.protobuf import descriptor_pb2
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

SERVICE = "nre.grpc.protos.sensorsim.SensorsimService"
_PACKAGE = SERVICE.rpartition(".")[0]

# Names and numbers of the lidars that a request can select.
DEVICES = {"PANDAR128": 0, "AT128": 1}
_ENUMS = {"LidarDeviceType": DEVICES}

# Fields of each message, as in a .proto file.
_MESSAGES = {
    "Empty": (),
    "Vec3": ("float x = 1", "float y = 2", "float z = 3"),
    "Quat": ("float w = 1", "float x = 2", "float y = 3", "float z = 4"),
    "Pose": ("Vec3 vec = 1", "Quat quat = 2"),
    "PosePair": ("Pose start_pose = 1", "Pose end_pose = 2"),
    "DynamicObject": ("string track_id = 1", "PosePair pose_pair = 2"),
    "LidarSpec": ("LidarDeviceType lidar_type = 2",),
    "LidarRenderRequest": (
        "string scene_id = 1",
        "LidarSpec lidar_config = 2",
        "fixed64 frame_start_us = 3",
        "fixed64 frame_end_us = 4",
        "PosePair sensor_pose = 5",
        "repeated DynamicObject dynamic_objects = 6",
    ),
    "LidarRenderReturn": (
        "repeated float point_xyzs = 1",
        "repeated float point_intensities = 2",
        "uint32 num_points = 3",
        "bytes point_xyzs_buffer = 4",
        "bytes point_intensities_buffer = 5",
    ),
    # Requests for camera images are only counted.
    "AggregatedRenderRequest": (
        "repeated bytes rgb_requests = 1",
        "repeated LidarRenderRequest lidar_requests = 2",
    ),
    "AggregatedRenderReturn": ("repeated LidarRenderReturn lidar_returns = 2",),
    "ApiVersion": ("uint32 major = 1", "uint32 minor = 2", "uint32 patch = 3"),
    "VersionId": (
        "string version_id = 1",
        "string git_hash = 2",
        "ApiVersion grpc_api_version = 3",
    ),
    "AvailableScenesReturn": ("repeated string scene_ids = 1",),
    "LoadedSceneEntry": (
        "string scene_id = 1",
        "uint64 loaded_instance_count = 2",
        "uint64 reusable_instance_count = 3",
    ),
    "LoadedScenesReturn": (
        "repeated LoadedSceneEntry scenes = 1",
        "uint64 loaded_instance_capacity = 2",
    ),
    "SceneRequest": ("string scene_id = 1",),
    "PoseAtTime": ("Pose pose = 1", "fixed64 timestamp_us = 2"),
    "Trajectory": ("repeated PoseAtTime poses = 1",),
    "AvailableTrajectory": ("Trajectory trajectory = 2",),
    "AvailableTrajectoriesReturn": ("repeated AvailableTrajectory available_trajectories = 1",),
}

# Methods that a lidar client calls: the request and the reply of each.
METHODS = {
    "render_lidar": ("LidarRenderRequest", "LidarRenderReturn"),
    "render_aggregated": ("AggregatedRenderRequest", "AggregatedRenderReturn"),
    "get_version": ("Empty", "VersionId"),
    "get_available_scenes": ("Empty", "AvailableScenesReturn"),
    "get_loaded_scenes": ("Empty", "LoadedScenesReturn"),
    "get_available_cameras": ("SceneRequest", "Empty"),
    "get_available_trajectories": ("SceneRequest", "AvailableTrajectoriesReturn"),
    "get_available_ego_masks": ("Empty", "Empty"),
}

# A packed list of floats is encoded like bytes. Declaring it as bytes avoids converting each number
# to a Python object.
_PACKED = "repeated float"


def message_class(name: str) -> Any:
    """Return the class of the message with the given name, such as "LidarRenderRequest"."""
    return GetMessageClass(_pool().FindMessageTypeByName(f"{_PACKAGE}.{name}"))


def proto_text() -> str:
    """Return a .proto file from which protoc generates clients in any language."""
    lines = [
        "// Sensor service of lidarpool, with the parts of AlpaSim's protocol that it supports.",
        'syntax = "proto3";',
        f"package {_PACKAGE};",
    ]
    for name, values in _ENUMS.items():
        lines += ["", f"enum {name} {{", *(f"  {key} = {n};" for key, n in values.items()), "}"]
    for name, fields in _MESSAGES.items():
        lines += ["", f"message {name} {{", *(f"  {field};" for field in fields), "}"]
    lines += ["", f"service {SERVICE.rpartition('.')[2]} {{"]
    lines += [f"  rpc {name} ({a}) returns ({b});" for name, (a, b) in METHODS.items()]
    return "\n".join([*lines, "}"]) + "\n"


@cache
def _pool() -> DescriptorPool:
    """Return a pool with the descriptors of all messages."""
    file = descriptor_pb2.FileDescriptorProto(
        name="lidarpool/sensor_service.proto", package=_PACKAGE, syntax="proto3"
    )
    for name, values in _ENUMS.items():
        enum = file.enum_type.add(name=name)
        for key, number in values.items():
            enum.value.add(name=key, number=number)
    for name, fields in _MESSAGES.items():
        file.message_type.add(name=name, field=_fields(fields))
    pool = DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    return pool


def _fields(declarations: tuple[str, ...]) -> Iterator[Any]:
    """Yield the descriptors of the fields of a message."""
    proto = descriptor_pb2.FieldDescriptorProto
    for declaration in declarations:
        kind, name, _, number = declaration.rsplit(maxsplit=3)
        if kind == _PACKED:
            kind = "bytes"
        label = proto.LABEL_REPEATED if kind.startswith("repeated ") else proto.LABEL_OPTIONAL
        kind = kind.removeprefix("repeated ")
        field = proto(name=name, number=int(number), label=label)
        if kind in _MESSAGES or kind in _ENUMS:
            field.type_name = f".{_PACKAGE}.{kind}"
            field.type = proto.TYPE_ENUM if kind in _ENUMS else proto.TYPE_MESSAGE
        else:
            field.type = proto.Type.Value(f"TYPE_{kind.upper()}")
        yield field
