"""Options shared by the readers of all mesh file formats.

Options for specific formats are defined by the dataclasses in `MeshFormat.options`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from ...schema.declared import about
from ..transform import Transform

LengthUnit = Annotated[
    Literal["um", "mm", "cm", "dm", "m", "km", "in", "ft", "yd", "mi"] | None,  # as in UNITS_M
    about(
        "length unit of the file, or of the heights in a raster (default: from the file, "
        "otherwise meters)"
    ),
]
UpAxis = Annotated[
    Literal["x", "y", "z"] | None,
    about("axis of the file that points up (default: defined by the file format)"),
]
OpacityMode = Literal["mask", "ignore"]
Opacity = Annotated[
    OpacityMode,
    about(
        "mask lets light pass where the image of a material is transparent; ignore disregards "
        "the transparency of images"
    ),
]


@dataclass(frozen=True, kw_only=True)
class MeshOptions:
    """Options for reading a mesh file of any format.

    `lidarsim.scene.scene.Scene.load` describes the options.
    """

    unit: LengthUnit = None
    up_axis: UpAxis = None
    transform: Transform | None = None  # applied after the unit and the up axis
    opacity: Opacity = "mask"
    colors: bool = False  # whether base colors are read
    materials: bool = False  # whether the material names of faces are read
    # Folders that can contain additional files, besides the folder of the mesh file.
    assets: str | Path | Sequence[str | Path] | None = None
    # Name or number of the animation to bake into the meshes. "" selects the first animation.
    animation: str | None = None

    @property
    def asset_folders(self) -> tuple[Path, ...]:
        """The folders in `assets`."""
        one_folder = isinstance(self.assets, (str, Path))
        folders = [self.assets] if one_folder else self.assets or ()
        return tuple(map(Path, folders))  # type: ignore[arg-type]
