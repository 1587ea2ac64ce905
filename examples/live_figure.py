"""Draw the live figure of the MATLAB example, with triangles colored by number of hits.

    python examples/live_figure.py                 # open a window, at a tenth of the scanner's rate
    python examples/live_figure.py figure.png      # save the final figure as an image

`frame.hit_counts()` returns the number of hits per triangle, which the MATLAB example calls
`numHits`. The method requires that the survey keeps every hit, so this script draws only a subset
of the points.
"""

from __future__ import annotations

import sys

import matplotlib.pyplot as plt
import numpy as np
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from lidarpool import Scene, Survey, simulate

PACE = 0.1  # relative to the scanner's rate of ten revolutions per second
KEPT = 5  # every fifth hit is drawn as a point


class LiveFigure:
    """Figure that shows the scene with colored triangles, the points and the sensor position.

    The gray scene is drawn only once. Each frame draws only the triangles that have been hit, which
    takes about ten milliseconds.
    """

    def __init__(self, scene: Scene, position: tuple[float, float, float]) -> None:
        self.corners = scene.vertices[scene.faces]
        self.num_hits = np.zeros(scene.triangles, np.int64)
        self.points = np.zeros((0, 3))
        self.figure = plt.figure(figsize=(9, 6.5))
        self.axes = self.figure.add_subplot(projection="3d", computed_zorder=False)
        lowest, highest = scene.bounds
        self.axes.set(xlim=(lowest[0], highest[0]), ylim=(lowest[1], highest[1]))
        self.axes.set(zlim=(lowest[2], highest[2]), xlabel="x (m)", ylabel="y (m)")
        self.axes.set_box_aspect(highest - lowest, zoom=1.05)
        self.axes.view_init(elev=35)
        gray = Poly3DCollection(self.corners, facecolor="0.85", edgecolor="none")
        self.axes.add_collection3d(gray)
        self.hit = Poly3DCollection(self.corners[:1], cmap="turbo", linewidth=2)
        self.hit.set(array=np.ones(1), clim=(0.5, 5.5), animated=True)
        self.axes.add_collection3d(self.hit)
        self.hit.set_edgecolor("face")  # triangles are smaller than a pixel
        self.cloud = self.axes.scatter([], [], [], s=0.3, c="black", animated=True)
        self.cloud.set_label("Points")
        self.axes.scatter(*position, marker="o", c="red", label="Sensor position")
        self.axes.legend(loc="upper left")
        self.figure.colorbar(
            self.hit, label="hits per triangle", shrink=0.6, ticks=range(1, 6), pad=0.12
        )
        self.figure.canvas.draw()
        self.background = self.figure.canvas.copy_from_bbox(self.figure.bbox)

    def on_frame(self, frame) -> None:
        self.num_hits += frame.hit_counts()
        self.points = np.concatenate([self.points, frame.points().positions[::KEPT]])
        hit = np.flatnonzero(self.num_hits)
        if len(hit):
            self.hit.set_verts(self.corners[hit])
            self.hit.set_array(self.num_hits[hit])
        self.cloud._offsets3d = self.points.T
        canvas = self.figure.canvas
        canvas.restore_region(self.background)
        self.axes.draw_artist(self.hit)
        self.axes.draw_artist(self.cloud)
        canvas.blit(self.figure.bbox)
        canvas.flush_events()

    def save(self, path: str) -> None:
        self.hit.set_animated(False)
        self.cloud.set_animated(False)
        self.figure.savefig(path, dpi=150)


def main() -> None:
    """Scan the six objects from one position, and draw each frame."""
    scene = Scene.seed()
    survey = Survey(poses=[(0, 0, 1)], columns=["triangle"])
    figure = LiveFigure(scene, (0, 0, 1))
    if sys.argv[1:]:
        simulate(scene, survey, on_frame=figure.on_frame)
        figure.save(sys.argv[1])
        return
    plt.show(block=False)
    simulate(scene, survey, on_frame=figure.on_frame, pace=PACE)
    plt.show()


if __name__ == "__main__":
    main()
