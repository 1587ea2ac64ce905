"""Scenes of points: files of points, and the surfels that are made from them."""
