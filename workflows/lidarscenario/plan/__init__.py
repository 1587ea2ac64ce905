"""Path planning with particle swarms, which search for a short path around discs in the plane."""

from .planning import Planning
from .tangents import shortest_path_length
from .trial import Plan, Trial, best, run_trial

__all__ = ["Plan", "Planning", "Trial", "best", "run_trial", "shortest_path_length"]
