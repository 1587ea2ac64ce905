"""Options for reading mesh files that all formats share.

Further options belong to formats: `MeshFormat.options` names the dataclass of a reader.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from ...schema.declared import about
from ..transform import Transform

LengthUnit = Annotated[
    Literal["um", "mm", "cm", "dm", "m", "km", "in", "ft", "yd", "mi"] | None,  # of UNITS_M
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

    `lidarsim.scene.scene.Scene.load` describes them.
    """

    unit: LengthUnit = None
    up_axis: UpAxis = None
    transform: Transform | None = None  # placement in the world, after unit and up axis
    opacity: Opacity = "mask"
    colors: bool = False  # whether base colors are read
    materials: bool = False  # whether faces keep the names of their materials
    # Folders whose files may be read, besides the folder of the file.
    assets: str | Path | Sequence[str | Path] | None = None
    # Name or number of the animation to play by the meshes; "" for the first, None for none.
    animation: str | None = None

    @property
    def asset_folders(self) -> tuple[Path, ...]:
        """The folders of `assets`."""
        one_folder = isinstance(self.assets, (str, Path))
        folders = [self.assets] if one_folder else self.assets or ()
        return tuple(map(Path, folders))  # type: ignore[arg-type]
