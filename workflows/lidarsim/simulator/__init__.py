"""The simulator: scene, sensors and physics make returns, and those make columns."""

from .scanner import Scanner

__all__ = ["Scanner"]
