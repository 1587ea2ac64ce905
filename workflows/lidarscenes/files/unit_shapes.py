"""Define shapes of size 1 or radius 1, centered at the origin, for robots and worlds."""

from __future__ import annotations

import numpy as np

from lidarsim.scene.actors import box
from lidarsim.scene.shapes import capsule, cylinder

SIDES = 64  # sides of a circle, which deviate from it by at most 0.12 % of the radius

UNIT_BOX = box("box", (1, 1, 1)).affine_transform("box", np.eye(3), np.array([0, 0, -0.5]))
UNIT_BALL = capsule(1, 0, SIDES, "sphere")
UNIT_CYLINDER = cylinder(1, 1, SIDES, "cylinder")
