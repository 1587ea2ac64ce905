"""What plug-ins that read mesh files import; docs/how-to/plugins.md has an example."""

from .scene.files.mesh_formats import MeshFormat
from .scene.files.scene_graph import Content, MeshFileError, ReadOptions
from .scene.scene_mesh import SceneMesh

__all__ = ["Content", "MeshFileError", "MeshFormat", "ReadOptions", "SceneMesh"]
