"""How the progress of writing an output is shown."""

from collections.abc import Callable

# Shows how much of an output is written: its name, items that are done, all items, their unit.
WritingProgress = Callable[[str, int, int, str], None]
