"""Scan patterns of sensors, estimated from recordings."""

from .fitting import PatternFit, fit_pattern

__all__ = ["PatternFit", "fit_pattern"]
