"""Entry point of the command, which Ctrl-C stops from the first moment on."""

from __future__ import annotations

from typing import NoReturn

from .base.interrupts import end_on_signals


def main() -> NoReturn:
    """Run the command, see `cli.main`."""
    end_on_signals()
    # A second of imports, during which an interrupt would print Python's traceback.
    from .cli.commands import main as command

    command()


if __name__ == "__main__":
    main()
