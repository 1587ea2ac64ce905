"""Fitting of sensor models to recordings."""
