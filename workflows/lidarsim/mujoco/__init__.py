"""Lidars in worlds of MuJoCo.

Arrays of the model and of its data are read; MuJoCo itself is not imported.
"""

from .mujoco_scanner import MujocoScanner

__all__ = ["MujocoScanner"]
