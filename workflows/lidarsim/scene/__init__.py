"""Scenes: meshes, files, transforms, and made-up ones."""
