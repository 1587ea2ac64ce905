"""Entry point of the `lidarpool` command, which exits cleanly on Ctrl-C even during imports."""

from __future__ import annotations

import sys
from typing import NoReturn, TextIO, cast

from lidarsim.environment.interrupts import exit_on_signals

from .processes.rare_collections import no_collections


def main() -> NoReturn:
    """Run the `lidarpool` command."""
    exit_on_signals()
    # A second of imports, during which an interrupt would print Python's traceback.
    with no_collections():
        from .cli.commands import main as command
        from .processes.streams import TolerantStream

    if sys.stdout is not None:  # `lidarpool run … | head -3` runs to its end
        sys.stdout = cast(TextIO, TolerantStream(sys.stdout, BrokenPipeError))
    command()


if __name__ == "__main__":
    main()
