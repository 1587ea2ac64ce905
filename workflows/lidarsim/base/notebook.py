"""Detection of notebooks, for displays in their cells."""

from __future__ import annotations

import sys
from typing import Any


def cell_display() -> Any:
    """Return `IPython.display` in a notebook, whose cells show printed text, else None."""
    if "ipykernel" not in sys.modules:
        return None
    from IPython import display, get_ipython

    shell: Any = get_ipython()
    return display if type(shell).__name__ == "ZMQInteractiveShell" else None
