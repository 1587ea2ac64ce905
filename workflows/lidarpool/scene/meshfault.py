"""What is wrong with a mesh file."""


class MeshFileError(Exception):
    """What is wrong with a mesh file, as a clause that follows its name."""
