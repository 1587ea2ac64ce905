"""Options for .boxes files."""

from dataclasses import dataclass
from typing import Annotated

from lidarsim.plugins import about


@dataclass(frozen=True)
class BoxesOptions:
    """Options that apply to .boxes files only."""

    grow_m: Annotated[float, about("length added to each side, in meters", ge=0, le=10)] = 0.0
