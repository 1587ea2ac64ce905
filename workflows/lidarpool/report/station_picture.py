"""The picture of stations: what they cover, what they do not, and what no station could see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..base.arrays import Bools, Floats, Ints
from ..base.words import counted
from ..plan.stations import Sight, StationPlan
from ..render import theme
from ..render.page import Page
from ..render.shot import SIZE, Samples, Shot, take_shot
from ..scene.scene import Scene

COVERED, UNCOVERED, HIDDEN = range(3)  # hidden from all candidates
COLOURS = np.stack([theme.rgb(c) for c in ("#5b9bd5", "#ee7733", theme.CLAY)])
_BLOCK = 4  # pixels a side


def draw_stations(scene: Scene, plan: StationPlan) -> Page:
    """Draw the scene of a plan by what its stations see: exactly, in each pixel, with shadows.

    Actors are left out.
    """
    shot = take_shot(replace(scene, actors=()), plan.stations)
    page = Page(SIZE)
    axes = page.show(shot, _by_coverage(shot, plan).paint(COLOURS, 0.6))
    page.numbers(axes, shot)
    names = ("covered", "not covered", "out of sight")
    page.legend([*zip(names, COLOURS, strict=True)], "station")
    places = counted(len(plan.candidates), "place")
    page.title(
        counted(len(plan.stations), "station").capitalize(),
        f"{plan.coverage[-1]:.1%} covered of what can be seen from {places}",
        plan.sight.sensor.model,
    )
    return page


def _by_coverage(shot: Shot, plan: StationPlan) -> Shot:
    """Return the shot with COVERED, UNCOVERED or HIDDEN in place of triangles."""
    sight = Sight(shot.uncut, plan.sight.sensor, plan.sight.slant_deg)  # it has been moved a little
    stations, places = (p - shot.scene.origin for p in (plan.stations, plan.candidates))
    width = shot.camera.size[0]
    kinds = np.full(shot.whole.triangle.size, HIDDEN)
    surface = np.flatnonzero(shot.whole.triangle >= 0)
    covered = _seen(sight, stations, shot.whole, surface)
    kinds[surface[covered]] = COVERED
    # Of each triangle one pixel in a block is asked: to ask all would take minutes.
    left = surface[~covered]
    block = left // width // _BLOCK * width + left % width // _BLOCK
    key = block * np.int64(len(shot.scene.faces)) + shot.whole.triangle[left]
    _, asked, alike = np.unique(key, return_index=True, return_inverse=True)
    visible = _seen(sight, places, shot.whole, left[asked])
    kinds[left[visible[alike]]] = UNCOVERED
    edges = shot.finer.triangle.size // max(len(shot.edges), 1)
    finer = np.repeat(np.where(kinds[shot.edges] == COVERED, HIDDEN, kinds[shot.edges]), edges)
    some = np.flatnonzero(shot.finer.triangle >= 0)
    finer[some[_seen(sight, stations, shot.finer, some)]] = COVERED
    return replace(shot, whole=_painted(shot.whole, kinds), finer=_painted(shot.finer, finer))


def _painted(samples: Samples, kinds: Ints) -> Samples:
    return replace(samples, triangle=np.where(samples.triangle >= 0, kinds, samples.triangle))


def _seen(sight: Sight, places: Floats, samples: Samples, which: Ints) -> Bools:
    """Whether any of places (p, 3) sees the side of the samples that the camera sees: (k,)."""
    points = samples.position[which].astype(np.float64)
    normals = samples.normal[which].astype(np.float64)
    seen = np.zeros(len(which), np.bool_)
    left = np.arange(len(which))
    for place in places:
        sides = sight.sides(place, points[left], normals[left])
        seen[left[sides > 0]] = True
        left = left[sides <= 0]
    return seen
