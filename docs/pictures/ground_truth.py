"""Draw the scene flow and the visible fractions of a sweep from above.

`python -m docs.pictures.ground_truth OUT.png RESULT` reads the result of the scenario in
docs/how-to/ground-truth.md. The left panel shows the flow relative to the sensor, and the right
panel shows the flow in the world. Arrows are three times as long as the displacements.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from docs.pictures.options import file_parser
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver

from lidarfiles.clouds.boxes import Boxes
from lidarpool import read_cloud
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.table import FLOW, FLOW_EGO
from lidarsim.motion.rotations import matrices

SWEEP = 5
SCALE = 3.0
PANELS = {"flow, relative to the sensor": FLOW, "flow_ego, in the world": FLOW_EGO}
CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) / 2


def draw_panel(axes: Axes, points: Cloud, boxes: Boxes, names: tuple[str, ...]) -> Quiver:
    """Draw the points of a sweep with arrows, and the boxes of its actors."""
    flow = np.stack([points[name] for name in names], axis=1) * SCALE
    x, y, _ = points.positions.T
    is_ground = points["class"] == 40
    size_m = np.linalg.norm(flow, axis=1) / SCALE
    axes.scatter(x[is_ground], y[is_ground], 0.15, "0.75")
    axes.scatter(x[~is_ground], y[~is_ground], 0.4, "0.45")
    rows = np.flatnonzero(~is_ground)[::3]
    arrows = axes.quiver(
        x[rows], y[rows], flow[rows, 0], flow[rows, 1], size_m[rows], cmap="viridis", clim=(0, 1.5),
        angles="xy", scale_units="xy", scale=1, width=0.002,
    )  # fmt: skip
    assert boxes.visibility is not None
    for row in np.flatnonzero(boxes.present):
        (turn,) = matrices(boxes.quaternions[[row]])
        center = boxes.centers[row, :2]
        outline = (CORNERS * boxes.sizes[row, :2]) @ turn[:2, :2].T + center
        axes.plot(*outline.T, color="tab:red", linewidth=1)
        label = f"{boxes.visibility.visible_fraction[row]:.0%}"
        axes.annotate(label, center + np.array([0.6, 0.9]), color="tab:red", fontsize=9)
    axes.set(xlim=(4, 34), ylim=(-11, 11), aspect="equal", xticks=[], yticks=[])
    return arrows


def main(arguments: list[str] | None = None) -> int:
    """Draw the picture and return the exit status."""
    parser = file_parser(__doc__, ".png")
    parser.add_argument("result", type=Path)
    options = parser.parse_args(arguments)
    mpl.use("agg")
    cloud = read_cloud(options.result / "cloud.ply")
    sweeps = cloud.sweeps()
    (points,) = sweeps.points(cloud, SWEEP, SWEEP + 1)
    boxes = Boxes.from_points(sweeps, SWEEP, points)
    figure = Figure(figsize=(12.6, 4.7), layout="constrained")
    panels = figure.subplots(1, 2)
    for axes, (title, names) in zip(panels, PANELS.items(), strict=True):
        arrows = draw_panel(axes, points, boxes, names)
        axes.set_title(title, fontsize=11)
    figure.colorbar(arrows, ax=panels, label="displacement in 0.1 s, m", shrink=0.8)
    figure.savefig(options.file, dpi=80)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
