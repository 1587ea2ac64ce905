"""Lidars in worlds that other programs move, such as MuJoCo, without importing these programs."""

from .mujoco_scanner import MujocoScanner

__all__ = ["MujocoScanner"]
