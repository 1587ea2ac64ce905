"""Features beside the core, one idea per module. The README lists the purpose of each module.

These modules import the core. Of the rest of the package, only `Pool`, `Partition`, `Pipe` and
`deploy` import them, and they never import these classes in turn. Modules that define a `Feature`
add it to `features.FEATURES`, through which the core calls it.
"""

from . import dashboard_page, inherit, metrics

__all__ = ["dashboard_page", "inherit", "metrics"]
