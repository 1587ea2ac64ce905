"""The simulator: from a scene and sensors to returns, and from returns to columns."""

from .scanner import Scanner

__all__ = ["Scanner"]
