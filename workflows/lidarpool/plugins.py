"""What plug-ins that write clouds import; docs/how-to/plugins.md has an example."""

from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.sweeps.sweeps import Sweeps

from .clouds.format_table import FormatRow
from .clouds.pieces import Pieces

__all__ = ["Cloud", "CloudLike", "FormatRow", "Pieces", "Sweeps"]
