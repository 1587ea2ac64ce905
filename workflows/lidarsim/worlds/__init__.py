"""Lidars in worlds that are controlled by other programs, such as MuJoCo.

The programs themselves are not imported.
"""

from .mujoco_scanner import MujocoScanner

__all__ = ["MujocoScanner"]
