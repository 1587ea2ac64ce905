"""Options of .boxes."""

from dataclasses import dataclass
from typing import Annotated

from lidarsim.plugins import about, checked_fields


@dataclass(frozen=True)
@checked_fields
class BoxesOptions:
    """Options that .boxes alone has."""

    grow_m: Annotated[float, about("length added to each side, metres", ge=0, le=10)] = 0.0
