"""The command `lidarpool view`."""

from __future__ import annotations

from pathlib import Path

import click


@click.command()
@click.argument("result", type=click.Path(path_type=Path))
@click.option(
    "--port",
    type=click.IntRange(0, 65_535),
    default=8080,
    show_default=True,
    help="Port on 127.0.0.1, or the next free one; 0 for any.",
)
@click.option("--no-browser", is_flag=True, help="Only print the address.")
def view(result: Path, port: int, no_browser: bool) -> None:
    """Show a result or a cloud in the browser.

    \b
    Examples:
      lidarpool view lidarpool-out
      lidarpool view lidarpool-out/cloud.ply --no-browser
    """  # noqa: D301 - click wants the character, not its name
    from ..live.result_page import view_result

    view_result(result, port=port, browser=not no_browser)
