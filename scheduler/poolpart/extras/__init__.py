"""Optional features that extend the core, one per module.

The README lists the purpose of each module. The modules import the core, but they never import
`Pool`, `Partition`, `Pipe` or `deploy`, which are the only importers of this folder. Modules that
define a `Feature` add it to `features.FEATURES`, through which the core calls it.
"""

from . import dashboard_page, inherit, metrics

__all__ = ["dashboard_page", "inherit", "metrics"]
