"""Draw an occupancy grid in the layout of SemanticKITTI.

`python -m docs.pictures.occupancy OUT.png FOLDER` reads the grids of the scenario in
docs/how-to/ground-truth.md. The left panel shows the classes of a layer of voxels, and the right
panel shows which voxels of this layer the rays of the sweep observe.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from docs.pictures.options import file_parser
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from lidarscenario.occupancy.layouts import SemanticKitti
from lidarsim.numerics.arrays import Bools, Integers

SWEEP = "000005"
LAYER = 6  # from 1.0 to 1.2 m above the ground
CLASSES = {0: ("free", "white"), 10: ("car", "#1f77b4"), 30: ("person", "#d62728"),
           50: ("building", "#c49c66")}  # fmt: skip
STATES = (("unobserved", "0.55"), ("free and observed", "#d9ecf7"),
          ("occupied, unobserved", "#c49c66"), ("occupied and observed", "#7f3b08"))  # fmt: skip


def read_bits(path: Path) -> Bools:
    """Read a packed grid."""
    bits = np.unpackbits(np.fromfile(path, np.uint8)).reshape(SemanticKitti.grid.shape)
    return bits.astype(np.bool_)


def draw_layer(axes: Axes, layer: Integers, entries: list[tuple[str, str]], title: str) -> None:
    """Draw a layer of voxels (x, y), whose values are indices into names and colors."""
    (x0, y0, _), (x1, y1, _) = SemanticKitti.grid.lower, SemanticKitti.grid.upper
    colors = ListedColormap([color for _, color in entries])
    axes.imshow(
        layer.T, colors, vmin=0, vmax=len(entries) - 1, origin="lower", extent=(x0, x1, y0, y1),
        interpolation="nearest",
    )  # fmt: skip
    handles = [Patch(facecolor=color, edgecolor="0.4", label=name) for name, color in entries]
    axes.legend(handles=handles, loc="upper right", fontsize=8)
    axes.set(title=title, xlabel="x, m", ylabel="y, m", ylim=(-20, 20))


def main(arguments: list[str] | None = None) -> int:
    """Draw the picture and return the exit status."""
    parser = file_parser(__doc__, ".png")
    parser.add_argument("folder", type=Path)
    options = parser.parse_args(arguments)
    mpl.use("agg")
    voxels = options.folder / "sequences/00/voxels"
    shape = SemanticKitti.grid.shape
    labels = np.fromfile(voxels / f"{SWEEP}.label", "<u2").reshape(shape)[:, :, LAYER]
    observed = ~read_bits(voxels / f"{SWEEP}.occluded")[:, :, LAYER]
    figure = Figure(figsize=(12, 5), layout="constrained")
    left, right = figure.subplots(1, 2)
    draw_layer(left, np.searchsorted([*CLASSES], labels), [*CLASSES.values()], "class (.label)")
    state = 2 * (labels > 0) + observed
    draw_layer(right, state, [*STATES], "observed by the sweep (.occluded)")
    left.plot(0, 0, "k^", markersize=9, clip_on=False)
    right.plot(0, 0, "k^", markersize=9, clip_on=False)
    figure.savefig(options.file, dpi=80)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
