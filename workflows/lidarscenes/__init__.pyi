from .robots.robot import Robot as Robot
from .robots.urdf import load_robot as load_robot

__all__ = [
    "Robot",
    "load_robot",
]
