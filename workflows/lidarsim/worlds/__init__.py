"""Lidars in worlds that other programs move, such as MuJoCo, of which nothing is imported."""

from .mujoco_scanner import MujocoScanner

__all__ = ["MujocoScanner"]
