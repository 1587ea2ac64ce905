"""Features beside the core: each module is an idea. The README says who asks for each of them.

The core does not import these modules. `Partition`, `Pool` and `Pipe` hand calls on to them, and
modules with a `Feature` begin and end with partitions.
"""

from . import dashboard_page, inherit, metrics

__all__ = ["dashboard_page", "inherit", "metrics"]
