"""Scenes, with their meshes, file formats, transforms and generated shapes."""
