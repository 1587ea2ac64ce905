"""Plots and films of the documentation.

Each module runs with `python -m docs.pictures.NAME`.
"""
