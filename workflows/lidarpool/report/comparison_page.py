"""The page and pictures of a comparison."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ..base.arrays import AnyArray
from ..base.choice import one_of_each_part
from ..base.words import counted
from ..render import theme
from ..render.page import Page
from .page.page import rendered
from .page.words import millimetres

if TYPE_CHECKING:
    from .comparison import Comparison


WIDTH = 1600
LEFT, RIGHT = 0.075, 0.845  # of charts, as shares of the width
MOST_DOTS = 120_000
A, B = "#4477aa", "#ee7733"
ONLY_A, ONLY_B = theme.rgb("#2ca25f"), theme.rgb("#101418")  # no colours of residuals
NONE = theme.rgb("#c8cbd0")  # within images, whatever the page's colours
RANGES, RESIDUALS, FAR = "viridis", "RdBu_r", "plasma"
SCALE = 6.0  # end of the scale of residuals, in median absolute deviations: about four sigma
CELLS = ("in_both", "in_a_only", "in_b_only", "returns_in_both")
CLOSEST_M = 0.001  # end of the scale of distances


def write_comparison(folder: Path, found: Comparison) -> list[str]:
    """Write compare.json, compare.html and pictures as PNG into a folder; return their names."""
    drawn = {"distances": draw_distances(found), "above": draw_above(found)}
    if found.images is not None:
        drawn = {"ranges": draw_ranges(found), "rings": draw_rings(found)} | drawn
    for name, page in drawn.items():
        (folder / f"compare-{name}.png").write_bytes(page.png())
    images = {name: page.svg() for name, page in drawn.items()}
    text = rendered("comparison.html", report=found.figures, pictures=images)
    (folder / "compare.html").write_text(text, encoding="utf-8")
    text = json.dumps(found.figures, indent=1, allow_nan=False) + "\n"
    (folder / "compare.json").write_text(text, encoding="utf-8")
    return ["compare.json", "compare.html", *(f"compare-{name}.png" for name in drawn)]


def draw_ranges(found: Comparison) -> Page:
    """Draw the range images of both, and their residuals, below each other."""
    images = found.images
    assert images is not None
    rows = len(images.rings)
    high = int(np.clip(2.2 * rows, 90, 300))  # pixels of an image
    top, gap, below = 150, 62, 90
    height = top + 3 * high + 2 * gap + below
    page = Page((WIDTH, height))
    page.title(
        "Range images",
        f"{counted(rows, 'ring')}, {counted(images.ranges[0].shape[1], 'column')} of "
        f"{images.step_deg:.4g}°",
    )
    both = np.concatenate([image[np.isfinite(image)] for image in images.ranges])
    low, most = np.quantile(both, (0.01, 0.98)) if len(both) else (0.0, 1.0)
    norm = LogNorm(max(float(low), 0.01), max(float(most), float(low) * 1.01, 0.02))
    (in_a, in_b), residual = images.there, images.ranges[0] - images.ranges[1]
    scale = Normalize(-_limit(found), _limit(found))
    for k, words in enumerate(("A", "B", "A − B")):
        bottom = (height - top - (k + 1) * high - k * gap) / height
        axes = page.chart((LEFT, bottom, RIGHT - LEFT, high / height), ylabel="elevation, °")
        if k < 2:
            painted = theme.mapped(RANGES, norm(np.nan_to_num(images.ranges[k], nan=low)).filled(0))
            painted[~images.there[k]] = NONE
        else:
            painted = theme.mapped(RESIDUALS, scale(1000 * np.nan_to_num(residual)).data)
            painted[~in_a & ~in_b] = NONE
            painted[in_a & ~in_b], painted[~in_a & in_b] = ONLY_A, ONLY_B
            axes.set_xlabel("azimuth, °")
        # As the sensor sees it: what is to its left is on the left.
        begin = images.begin_deg - images.step_deg / 2
        end = begin + painted.shape[1] * images.step_deg
        extent = (end, begin, rows - 0.5, -0.5)
        axes.imshow(painted[:, ::-1], aspect="auto", interpolation="nearest", extent=extent)
        some = np.unique(np.linspace(0, rows - 1, min(rows, 5)).round().astype(int))
        axes.set_yticks(some, [f"{images.elevation_deg[row]:.1f}" for row in some])
        axes.grid(False)
        page.heading(axes, words)
    share = high / height
    bottom = (height - top - 2 * high - gap) / height
    ramp = np.linspace(0, 1, 256)
    frame = (0.862, bottom, 0.014, 2 * share + gap / height)
    page.colour_bar(theme.mapped(RANGES, ramp), norm, "range, m", frame)
    frame = (0.862, below / height, 0.014, share)
    page.colour_bar(theme.mapped(RESIDUALS, ramp), scale, "A − B, mm", frame)
    named = (("only A has a return", ONLY_A), ("only B has a return", ONLY_B),
             ("no return", NONE))  # fmt: skip
    handles = [_dot(text, colour) for text, colour in named]
    _key(page, page.figure, handles, loc="upper right", bbox_to_anchor=(RIGHT, 1 - 40 / height))
    return page


def draw_rings(found: Comparison) -> Page:
    """Draw residuals and lost returns of each ring, and a histogram of all residuals."""
    image = found.figures["range_image"]
    rows = [row for row in image["rings"] if row["cells"]]
    height = 760
    page = Page((WIDTH, height))
    page.title("Residuals by ring", f"A − B in {image['residual']['cells']:,} {image['paired_by']}")
    elevation = np.array([row["elevation_deg"] for row in rows])
    lows, middles, highs, means = (
        1000 * np.array([row[name] for row in rows])
        for name in ("p05_m", "median_m", "p95_m", "bias_m")
    )
    lost = image["no_return"] is not None
    wide, apart = (0.24, 0.075) if lost else (0.4, 0.1)
    axes = page.chart((LEFT, 0.13, wide, 0.64), xlabel="A − B, mm", ylabel="elevation, °")
    thick = float(np.clip(150 / max(len(rows), 1), 0.7, 4)) * page.unit
    axes.hlines(elevation, lows, highs, color=theme.UNSEEN, lw=thick)
    axes.axvline(0, color=theme.MUTED, lw=0.7 * page.unit)
    size = 3.4 * page.unit if len(rows) < 40 else 2 * page.unit
    axes.plot(middles, elevation, "o", color=A, ms=size, mew=0)
    axes.plot(means, elevation, "|", color=theme.SENSOR, ms=2 * size, mew=0.8 * page.unit)
    limit = _limit(found)
    axes.set_xlim(-limit, limit)
    handles = [
        _dot("median", A), _dot("mean", theme.SENSOR, "|"), _dot("5 to 95 %", theme.UNSEEN, "_"),
    ]  # fmt: skip
    _key(page, axes, handles)
    left = LEFT + wide + apart
    if lost:
        axes = page.chart((left, 0.13, wide, 0.64), xlabel="cells without a return, %")
        counts = np.array([[row["no_return"][name] for name in CELLS] for row in rows])
        for colour, which, words in ((B, 2, "B"), (A, 1, "A")):
            share = 100 * (counts[:, 0] + counts[:, which]) / counts.sum(axis=1)
            axes.plot(share, elevation, "o-", color=colour, ms=size, mew=0, lw=0.6 * page.unit,
                      label=words)  # fmt: skip
        axes.set_xlim(left=min(0, axes.get_xlim()[0]))
        _key(page, axes, [_dot("A", A), _dot("B", B)])
        left += wide + apart
    axes = page.chart((left, 0.13, wide, 0.64), xlabel="A − B, mm; more in the outer bins",
                      ylabel="cells", yscale="log")  # fmt: skip
    width = np.ceil(limit / 25) if limit > 10 else limit / 25  # ranges are often whole millimetres
    half = np.floor(limit / width) + 0.5
    edges = np.arange(-half, half + 1) * width
    values = np.clip(1000 * found.residuals, edges[0], edges[-1])
    axes.hist(values, bins=edges.tolist(), color=A)
    return page


def draw_distances(found: Comparison) -> Page:
    """Draw cumulative distances in both directions, and intensities of A and B if known."""
    height = 760
    page = Page((WIDTH, height))
    far = found.figures["distances"]
    page.title(
        "Distances to the nearest neighbour",
        f"medians: A to B {millimetres(far['a_to_b']['median_m'])}, B to A "
        f"{millimetres(far['b_to_a']['median_m'])}",
    )
    wide = 0.4 if found.figures["intensity"] else 0.77
    axes = page.chart((LEFT, 0.13, wide, 0.64), xlabel="distance, m", ylabel="points within, %",
                      xscale="log", ylim=(0, 101))  # fmt: skip
    most = CLOSEST_M
    for values, colour in zip(found.distances, (A, B), strict=True):
        ordered = np.sort(values)
        some = np.unique(np.linspace(0, len(ordered) - 1, 2000).astype(int))
        axes.plot(
            np.maximum(ordered[some], CLOSEST_M), 100 * (some + 1) / len(ordered), color=colour,
            lw=1.4 * page.unit,
        )  # fmt: skip
        most = max(most, float(np.quantile(ordered, 0.999)))
    axes.set_xlim(CLOSEST_M, max(2 * most, 0.01))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    for one in far["f_scores"]:
        axes.axvline(one["distance_m"], color=theme.LINE, lw=0.9 * page.unit, ls=(0, (4, 3)))
    _key(page, axes, [_dot("A to B", A), _dot("B to A", B)], loc="lower right", bbox_to_anchor=None)
    if found.figures["intensity"]:
        light = found.figures["intensity"]
        axes = page.chart((LEFT + 0.5, 0.13, 0.4, 0.64), xlabel="intensity in B",
                          ylabel="intensity in A")  # fmt: skip
        mine, theirs = found.lights
        axes.hist2d(theirs, mine, (_bins(theirs), _bins(mine)), norm=LogNorm(), cmap="viridis",
                    rasterized=True)  # fmt: skip
        axes.grid(False)
        told = f"rank correlation {light['rank_correlation']:.3f}"
        page.heading(axes, f"{told} of {light['pairs']:,} {light['of']}")
    return page


def draw_above(found: Comparison) -> Page:
    """Draw both clouds from above, coloured by the distance to the other."""
    height = 830
    page = Page((WIDTH, height))
    page.title("From above", "the nearest neighbour in the other cloud; the farthest on top")
    above = found.above
    low = np.min([np.quantile(points[:, :2], 0.01, axis=0) for points, _ in above], axis=0)
    high = np.max([np.quantile(points[:, :2], 0.99, axis=0) for points, _ in above], axis=0)
    side = 1.06 * max(float((high - low).max()), 1e-3) / 2
    wide, tall = 0.36, 0.36 * WIDTH / height
    everything = np.concatenate([distances for _, distances in above])
    most = max(float(np.quantile(everything, 0.99)), 10 * CLOSEST_M)
    least = max(CLOSEST_M, min(float(np.quantile(everything, 0.05)), most / 10))
    norm = LogNorm(least, most)
    for k, (points, distances) in enumerate(above):
        axes = page.chart((LEFT + k * (wide + 0.045), 0.12, wide, tall), xlabel="x, m",
                          ylabel="" if k else "y, m")  # fmt: skip
        some = one_of_each_part(len(points), MOST_DOTS)
        some = some[np.argsort(distances[some])]
        axes.scatter(
            points[some, 0], points[some, 1], c=np.maximum(distances[some], least),
            cmap=FAR, norm=norm, s=(1.6 if len(some) > 40_000 else 3) * page.unit**2, lw=0,
            rasterized=True,
        )  # fmt: skip
        middle = (low + high) / 2
        axes.set(xlim=middle[0] + np.array([-side, side]), ylim=middle[1] + np.array([-side, side]))
        page.heading(axes, ("A, distance to B", "B, distance to A")[k])
    page.colour_bar(theme.mapped(FAR, np.linspace(0, 1, 256)), norm, "distance, m",
                    (0.875, 0.12, 0.014, tall))  # fmt: skip
    return page


def _limit(found: Comparison) -> float:
    """End of the scale of residuals, millimetres."""
    told = found.figures["range_image"]["residual"]
    return max(1000 * (abs(told["median_m"]) + SCALE * told["mad_m"]), 0.1) if told["cells"] else 1


def _bins(values: AnyArray) -> AnyArray:
    """Edges of bins of intensities, between whole numbers if they are such."""
    most = max(float(np.quantile(values, 0.995)), 1e-12)
    if most <= 300 and (values == np.round(values)).all():
        return np.arange(-0.5, most + 1)
    return np.linspace(0, most, 121)


def _dot(text: str, colour: Any, marker: str = "s") -> Line2D:
    edge = theme.MUTED if marker == "s" else colour
    return Line2D([], [], ls="", marker=marker, color=colour, mec=edge, mew=0.5, label=text, ms=4)


def _key(page: Page, on: Axes | Figure, handles: list[Line2D], **given: Any) -> None:
    """Put a legend above axes, or elsewhere."""
    above = {"loc": "upper left", "bbox_to_anchor": (0, 1.09), "borderaxespad": 0}
    style = {"ncols": len(handles), "handletextpad": 0.2, "columnspacing": 1.2, "borderpad": 0.4}
    page.key(handles, 6.8, on, **style, **(given or above))
