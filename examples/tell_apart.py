"""Tells ground, buildings and cars apart: a campaign of cities, and a network in NumPy.

    python tell_apart.py [FOLDER | stream]

It makes a data set of 30 cities, or streams them from their workers, learns from some, and draws
what it says of another."""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

import lidarpool as lp
from lidarscenes.procedural.city import city

CLASSES = ("ground", "building", "car", "tree or lamp")  # 1 to 4 in the column `class`
COLOURS = ListedColormap(("#aab2bb", "#4477aa", "#ee7733", "#44aa77"))
SIDES = (0.4, 2.0)  # of cells around a point, metres
WIDTHS, BATCH, EPOCHS, RATE = (64, 32), 1024, 6, 2e-3
RNG = np.random.default_rng(1)


def street(number, rng):
    """Make a job: three sweeps in a city of its own."""
    values = {"cars": int(rng.integers(40, 110)), "trees": int(rng.integers(10, 100))}
    scene = city(40_000, seed=number, **values)
    values["visibility_km"] = round(float(np.exp(rng.uniform(np.log(0.1), np.log(10)))), 3)
    places = np.column_stack([rng.uniform(-40, 40, 3), rng.uniform(-3, 3, 3), np.full(3, 1.9)])
    survey = lp.Survey(
        sensor=lp.load_sensor("ouster/os1-32"),
        poses=[lp.Pose(tuple(place), yaw_deg=float(rng.uniform(-180, 180))) for place in places],
        materials=[  # of the entries for an object, the first counts
            lp.Material(["Saloon*", "Estate*", "Panel van*"], 0.5, semantic_class=3),
            lp.Material("building-*", 0.4, semantic_class=2),
            lp.Material(["ground", "pavement"], 0.3, semantic_class=1),
            lp.Material("*", 0.45, semantic_class=4),
        ],
        noise=lp.Noise(range_m=0.015, detection_range_m=90), visibility_km=values["visibility_km"],
        keep_every=1, columns=["intensity", "class"], classes=dict(enumerate(CLASSES, 1)),
    )  # fmt: skip
    return lp.Job(scene, survey, values=values)


def features(sweep):
    """What the network knows of each point, (n, 17)."""
    points = sweep.points.astype(float)
    away, z = np.linalg.norm(points, axis=1), points[:, 2]
    known = [z, np.log(away), np.log(sweep.intensity * away**2 + 1e-3)]
    for side in SIDES:
        # The column of air: how high is the point above the ground, how high is what stands here?
        cell = np.floor(points[:, :2] / side).astype(int)
        cell -= cell.min(axis=0) - 1  # with a cell around all others
        rows, columns = cell.max(axis=0) + 2
        cell = cell @ (columns, 1)
        low, high = np.full(rows * columns, np.inf), np.full(rows * columns, -np.inf)
        np.minimum.at(low, cell, z)
        np.maximum.at(high, cell, z)
        near = cell + np.add.outer((-columns, 0, columns), (-1, 0, 1)).reshape(9, 1)
        ground, top = low[near].min(axis=0), high[near].max(axis=0)
        known += [z - ground, top - ground, high[cell] - z, high[cell] - low[cell]]
        # The surface: the covariance of the points in a cube has its normal and its roughness.
        _, cube = np.unique(np.floor(points / side), axis=0, return_inverse=True)
        count = np.bincount(cube)
        mean = np.stack([np.bincount(cube, axis) / count for axis in points.T], axis=1)
        off = points - mean[cube]
        products = (off[:, k] * off[:, n] for k in range(3) for n in range(3))
        spread = np.stack([np.bincount(cube, one) / count for one in products], axis=1)
        squares, ways = np.linalg.eigh(spread.reshape(-1, 3, 3))
        thick, wide, long = np.sqrt(squares.clip(0)).T
        surface = np.abs(ways[:, 2, 0]), thick / side, (wide - thick) / (long + 1e-6)
        known += [one[cube] for one in surface]
    return np.stack(known, axis=1, dtype=np.float32)


def sweeps_of(place, split):
    """Sweeps of a split: of the data set, which is made first, or just as they are cast."""
    campaign = lp.Campaign(street, 30, seed=1, splits={"train": 0.7, "test": 0.3})
    if place == "stream":
        return campaign.stream(split=split)
    if not Path(place, "dataset.json").exists():
        campaign.run(place)
    return lp.sweeps(place, split=split)


def read(place, split, share):
    """Features and classes of a random share of the points of a split."""
    known, classes = [], []
    for sweep in sweeps_of(place, split):
        some = RNG.random(len(sweep)) < share
        known.append(features(sweep)[some])
        classes.append(sweep.classes[some] - 1)
    return np.concatenate(known), np.concatenate(classes)


class Network:
    """Layers of rectified linear units; the highest of its outputs (n, 4) is the class."""

    def __init__(self, known):
        self.mean, self.scale = known.mean(axis=0), known.std(axis=0)
        widths = (known.shape[1], *WIDTHS, len(CLASSES))
        self.weights = [RNG.normal(0, np.sqrt(2 / a), (a + 1, b)) for a, b in pairwise(widths)]
        self.slopes = [(np.zeros_like(w), np.zeros_like(w)) for w in self.weights]  # and squares

    def layers(self, known):
        """Yield the inputs of each layer, with a 1 for its bias, and the outputs of the last."""
        inputs = (known - self.mean) / self.scale
        for weights in self.weights:
            yield (inputs := np.column_stack([inputs, np.ones(len(inputs))]))
            outputs = inputs @ weights
            inputs = outputs.clip(0)
        yield outputs

    def says(self, known):
        return [*self.layers(known)][-1].argmax(axis=1)

    def learn(self, known, classes, weight, step, steps):
        """Take a step of Adam (Kingma and Ba, 2015) down the weighted cross-entropy."""
        *inputs, out = self.layers(known)
        error = np.exp(out - np.logaddexp.reduce(out, axis=1, keepdims=True))  # shares, less 1
        error[np.arange(len(known)), classes] -= 1
        error *= (weight / weight.sum())[:, None]
        for k in reversed(range(len(inputs))):
            gradient = inputs[k].T @ error
            error = (error @ self.weights[k].T * (inputs[k] > 0))[:, :-1]
            slope, square = self.slopes[k]
            slope += 0.1 * (gradient - slope)
            square += 0.001 * (gradient**2 - square)
            ahead = slope / (1 - 0.9**step) / (np.sqrt(square / (1 - 0.999**step)) + 1e-8)
            self.weights[k] -= RATE * (1 - step / steps) * ahead


def main(place="cities"):
    known, classes = read(place, "train", 0.4)
    network = Network(known)
    rare = 1 / np.sqrt(np.bincount(classes))  # else it would learn nothing but ground and walls
    for step in range(steps := EPOCHS * len(known) // BATCH):
        some = RNG.integers(len(known), size=BATCH)
        network.learn(known[some], classes[some], rare[classes[some]], step + 1, steps)

    known, classes = read(place, "test", 1)
    table = np.bincount(4 * classes + network.says(known), minlength=16).reshape(4, 4)
    print(f"{table.trace() / table.sum():.1%} of {len(known):,} points are right.")
    for name, row in zip(CLASSES, table / table.sum(axis=1, keepdims=True), strict=True):
        print(f"{name:>14} is", *(f"{n:6.1%} {one}" for one, n in zip(CLASSES, row, strict=True)))
    sweep = next(iter(sweeps_of(place, "test")))
    figure = Figure((14, 7.4), layout="constrained")
    shown = {"What it is": sweep.classes - 1, "What it says": network.says(features(sweep))}
    for axes, (title, some) in zip(figure.subplots(1, 2), shown.items(), strict=True):
        dots = axes.scatter(*sweep.points[:, :2].T, s=1, c=some, cmap=COLOURS, vmin=-0.5, vmax=3.5)
        axes.set(xlim=(-40, 40), ylim=(-40, 40), aspect="equal", title=title, xlabel="m")
    figure.legend(dots.legend_elements()[0], CLASSES, loc="outside lower center", ncols=4)
    figure.savefig("tell-apart.png", dpi=120)


if __name__ == "__main__":
    main(*sys.argv[1:])
