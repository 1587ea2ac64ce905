"""Add scene formats, robots, procedural scenes, and importers for other programs to lidarsim."""

from lidarsim.environment.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        ".robots.robot": "Robot",
        ".robots.urdf": "load_robot",
    },
)
