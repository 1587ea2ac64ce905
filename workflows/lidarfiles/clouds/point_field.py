"""Description of a field that a format has for each point."""

from __future__ import annotations

from dataclasses import dataclass

OMITTED = "omitted"  # value of `PointField.missing` for fields that are not written
NONE = "not simulated"  # value of `PointField.source` for fields that are never known


@dataclass(frozen=True)
class PointField:
    """Point field of a format, including fields that only its standard or its readers define.

    Parameters
    ----------
    name
        Name of the field in the format.
    columns
        Columns from which the field is filled.
    missing
        What the format stores if the columns are missing, such as "0" or `OMITTED`. Empty if the
        cloud must have the columns.
    source
        Source of the field if it is not filled from columns, or `NONE` if it is never known.
    on_request
        Whether a run computes the columns only if they are listed in `cloud.columns`. Otherwise, it
        always computes them for the format.
    if_named
        Whether the field is only written if the classes have names.
    """

    name: str
    columns: tuple[str, ...] = ()
    missing: str = ""
    source: str = ""
    on_request: bool = False
    if_named: bool = False

    @property
    def is_required(self) -> bool:
        """Whether the cloud must have the columns."""
        return bool(self.columns) and not self.missing
