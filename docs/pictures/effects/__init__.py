"""Plots of the effects in docs/effects.md.

Each module draws the plot of an effect and returns a survey with the effect.
"""
