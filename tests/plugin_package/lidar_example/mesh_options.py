"""Options for .boxes files."""

from dataclasses import dataclass
from typing import Annotated

from lidarsim.plugins import about, checked_fields


@dataclass(frozen=True)
@checked_fields
class BoxesOptions:
    """Options that apply to .boxes files only."""

    grow_m: Annotated[float, about("length added to each side, in meters", ge=0, le=10)] = 0.0
