"""Readers of mesh files: bytes in, meshes and scene graphs out."""
