"""Lidars in worlds that are controlled by other programs, such as MuJoCo.

The programs themselves are not imported.
"""

from .mujoco_scanner import MujocoScanner
from .newton_scanner import NewtonScanner
from .world_follower import WorldFollower

__all__ = ["MujocoScanner", "NewtonScanner", "WorldFollower"]
