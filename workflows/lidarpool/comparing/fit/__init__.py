"""Fits a sensor to a recording: its sweeps in cells, surfaces, motion, statistics and charts."""

from .fitting import Fit, fit

__all__ = ["Fit", "fit"]
