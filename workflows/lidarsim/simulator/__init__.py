"""The simulator: scene, sensors and physics produce returns, and returns are the sources of columns."""

from .scanner import Scanner

__all__ = ["Scanner"]
