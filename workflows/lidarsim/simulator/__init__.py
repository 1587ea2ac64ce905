"""The lidar simulator, which casts sensor pulses into a scene and computes point columns."""

from .scanner import Scanner

__all__ = ["Scanner"]
