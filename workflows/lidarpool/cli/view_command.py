"""The command `lidarpool view`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from .options import Place, flag

if TYPE_CHECKING:
    from ..base.storage import Storage


@click.command()
@click.argument("result", type=Place())
@click.option(
    "--port",
    type=click.IntRange(0, 65_535),
    default=8080,
    show_default=True,
    help="Port on 127.0.0.1, or the next free one; 0 for any.",
)
@flag("--no-browser", help="Only print the address.")
def view(result: Path | Storage, port: int, no_browser: bool) -> None:
    """Show a result or a cloud in the browser.

    \b
    Examples:
      lidarpool view lidarpool-out
      lidarpool view lidarpool-out/cloud.ply --no-browser
    """  # noqa: D301 - click wants the character, not its name
    from ..export.folder import local_result
    from ..export.sweeps import SWEEPS_FILE
    from ..live.result_page import CLOUD, view_result
    from ..run.picture_file import PICTURE_FILE

    with local_result(result, (CLOUD, PICTURE_FILE, SWEEPS_FILE)) as made:
        view_result(made, port=port, browser=not no_browser)
