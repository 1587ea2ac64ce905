"""Fitting of sensor models to recordings."""

from .fitting import Fit, fit

__all__ = ["Fit", "fit"]
