"""Public names for plug-ins that add mesh formats or packet formats.

See docs/how-to/plugins.md for examples.
"""

from .packets.encoders import Datagrams, PacketEncoder, PacketSource
from .packets.service import Destination, Service
from .packets.shots import CarryOver, Shots
from .scene.files.mesh_formats import MeshFormat
from .scene.files.scene_graph import Content, MeshFileError, ReadOptions
from .scene.scene_mesh import SceneMesh
from .schema.declared import about

__all__ = [
    "CarryOver",
    "Content",
    "Datagrams",
    "Destination",
    "MeshFileError",
    "MeshFormat",
    "PacketEncoder",
    "PacketSource",
    "ReadOptions",
    "SceneMesh",
    "Service",
    "Shots",
    "about",
]
