"""Type of the callbacks that report the progress of writing an output."""

from collections.abc import Callable

# The arguments are the name of the output, the number of items written, the total number of items,
# and their unit.
WritingProgress = Callable[[str, int, int, str], None]
