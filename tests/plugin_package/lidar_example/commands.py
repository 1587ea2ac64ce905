"""The command `lidarpool highest RESULT`."""

from pathlib import Path

import click


@click.command()
@click.argument("result", type=click.Path(path_type=Path))
def highest(result: Path) -> None:
    """Print the height of the highest point in a result."""
    from lidarpool import read_cloud  # imported here to keep --help fast

    cloud = read_cloud(result / "cloud.ply")
    click.echo(f"{cloud.bounds[1, 2]:.2f} m")
