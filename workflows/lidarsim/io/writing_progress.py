"""Type of the callbacks that report the progress of writing an output or reading an input."""

from collections.abc import Callable

# The arguments are the name of the output or the activity, the number of completed items, the total
# number of items, and their unit.
WritingProgress = Callable[[str, int, int, str], None]
