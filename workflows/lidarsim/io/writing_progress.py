"""Type of functions that show the progress of writing an output."""

from collections.abc import Callable

# Shows the progress of an output: name, number of items done, number of all items, their unit.
WritingProgress = Callable[[str, int, int, str], None]
