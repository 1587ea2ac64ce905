"""Classify ground, buildings and cars with a NumPy neural network trained on generated cities.

    python tell_apart.py [FOLDER | stream]

The script creates a data set of 30 cities, or streams the sweeps from the workers. It trains the
network on some of the cities, evaluates it on the others, and draws the classes of one sweep.
"""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

import lidarpool as lp
from lidarscenes.procedural.city import city

CLASSES = ("ground", "building", "car", "tree or lamp")  # 1 to 4 in the column `class`
COLORS = ListedColormap(("#aab2bb", "#4477aa", "#ee7733", "#44aa77"))
SIDES = (0.4, 2.0)  # side lengths of the cells around a point, meters
WIDTHS = (64, 32)  # widths of the hidden layers
BATCH = 1024  # points per batch
EPOCHS = 6
RATE = 2e-3  # learning rate
RNG = np.random.default_rng(1)


def street(number, rng):
    """Return a job that simulates three sweeps in a randomly generated city."""
    values = {"cars": int(rng.integers(40, 110)), "trees": int(rng.integers(10, 100))}
    scene = city(40_000, seed=number, **values)
    values["visibility_km"] = round(float(np.exp(rng.uniform(np.log(0.1), np.log(10)))), 3)
    positions = np.column_stack([rng.uniform(-40, 40, 3), rng.uniform(-3, 3, 3), np.full(3, 1.9)])
    survey = lp.Survey(
        sensor=lp.load_sensor("ouster/os1-32"),
        poses=[
            lp.Pose(tuple(position), yaw_deg=float(rng.uniform(-180, 180)))
            for position in positions
        ],
        materials=[  # the first matching entry applies
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
    """Return the inputs of the network for each point.

    The shape is (n, 17).
    """
    points = sweep.points.astype(float)
    range_m = np.linalg.norm(points, axis=1)
    z = points[:, 2]
    columns = [z, np.log(range_m), np.log(sweep.intensity * range_m**2 + 1e-3)]
    for side in SIDES:
        columns += column_features(points, side)
        columns += surface_features(points, side)
    return np.stack(columns, axis=1, dtype=np.float32)


def column_features(points, side):
    """Return the height of each point relative to the lowest and highest points nearby."""
    z = points[:, 2]
    cell = np.floor(points[:, :2] / side).astype(int)
    cell -= cell.min(axis=0) - 1  # leaves a border of empty cells
    rows, columns = cell.max(axis=0) + 2
    cell = cell @ (columns, 1)
    lowest = np.full(rows * columns, np.inf)
    highest = np.full(rows * columns, -np.inf)
    np.minimum.at(lowest, cell, z)
    np.maximum.at(highest, cell, z)
    neighbors = cell + np.add.outer((-columns, 0, columns), (-1, 0, 1)).reshape(9, 1)
    ground = lowest[neighbors].min(axis=0)
    top = highest[neighbors].max(axis=0)
    return [z - ground, top - ground, highest[cell] - z, highest[cell] - lowest[cell]]


def surface_features(points, side):
    """Compute normals and roughness from the points in each cube, and return them as features."""
    _, cube = np.unique(np.floor(points / side), axis=0, return_inverse=True)
    count = np.bincount(cube)
    mean = np.stack([np.bincount(cube, axis) / count for axis in points.T], axis=1)
    offsets = points - mean[cube]
    products = (offsets[:, k] * offsets[:, n] for k in range(3) for n in range(3))
    covariance = np.stack([np.bincount(cube, values) / count for values in products], axis=1)
    squares, axes = np.linalg.eigh(covariance.reshape(-1, 3, 3))
    thickness, width, length = np.sqrt(squares.clip(0)).T
    surface = np.abs(axes[:, 2, 0]), thickness / side, (width - thickness) / (length + 1e-6)
    return [values[cube] for values in surface]


def sweeps_of(folder, split):
    """Return the sweeps of a split.

    The sweeps are streamed, or read from a data set that is created if necessary.
    """
    campaign = lp.Campaign(street, 30, seed=1, splits={"train": 0.7, "test": 0.3})
    if folder == "stream":
        return campaign.stream(split=split)
    if not Path(folder, "dataset.json").exists():
        campaign.run(folder)
    return lp.sweeps(folder, split=split)


def read(folder, split, share):
    """Return the features and classes of a random sample of the points in a split."""
    point_features = []
    classes = []
    for sweep in sweeps_of(folder, split):
        sampled = RNG.random(len(sweep)) < share
        point_features.append(features(sweep)[sampled])
        classes.append(sweep.classes[sampled] - 1)
    return np.concatenate(point_features), np.concatenate(classes)


class Network:
    """Neural network with ReLU layers that classifies each point."""

    def __init__(self, features):
        self.mean = features.mean(axis=0)
        self.scale = features.std(axis=0)
        widths = (features.shape[1], *WIDTHS, len(CLASSES))
        self.weights = [RNG.normal(0, np.sqrt(2 / a), (a + 1, b)) for a, b in pairwise(widths)]
        # Running means of the gradients and of their squares.
        self.slopes = [(np.zeros_like(w), np.zeros_like(w)) for w in self.weights]

    def layers(self, features):
        """Yield the inputs of each layer, with a 1 for the bias, and then the final outputs."""
        inputs = (features - self.mean) / self.scale
        for weights in self.weights:
            yield (inputs := np.column_stack([inputs, np.ones(len(inputs))]))
            outputs = inputs @ weights
            inputs = outputs.clip(0)
        yield outputs

    def says(self, features):
        return [*self.layers(features)][-1].argmax(axis=1)

    def learn(self, features, classes, weight, step, steps):
        """Reduce the weighted cross-entropy with one step of Adam (Kingma and Ba, 2015)."""
        *inputs, outputs = self.layers(features)
        error = np.exp(
            outputs - np.logaddexp.reduce(outputs, axis=1, keepdims=True)
        )  # the probability of each class
        error[np.arange(len(features)), classes] -= 1
        error *= (weight / weight.sum())[:, None]
        for k in reversed(range(len(inputs))):
            gradient = inputs[k].T @ error
            error = (error @ self.weights[k].T * (inputs[k] > 0))[:, :-1]
            slope, square = self.slopes[k]
            slope += 0.1 * (gradient - slope)
            square += 0.001 * (gradient**2 - square)
            ahead = slope / (1 - 0.9**step) / (np.sqrt(square / (1 - 0.999**step)) + 1e-8)
            self.weights[k] -= RATE * (1 - step / steps) * ahead


def main(folder="cities"):
    point_features, classes = read(folder, "train", 0.4)
    network = Network(point_features)
    # Without these weights, ground and walls would dominate the training.
    rare = 1 / np.sqrt(np.bincount(classes))
    for step in range(steps := EPOCHS * len(point_features) // BATCH):
        rows = RNG.integers(len(point_features), size=BATCH)
        network.learn(point_features[rows], classes[rows], rare[classes[rows]], step + 1, steps)

    point_features, classes = read(folder, "test", 1)
    table = np.bincount(4 * classes + network.says(point_features), minlength=16).reshape(4, 4)
    print(f"{table.trace() / table.sum():.1%} of {len(point_features):,} points are right.")
    for name, row in zip(CLASSES, table / table.sum(axis=1, keepdims=True), strict=True):
        print(
            f"{name:>14} is", *(f"{n:6.1%} {label}" for label, n in zip(CLASSES, row, strict=True))
        )
    sweep = next(iter(sweeps_of(folder, "test")))
    figure = Figure((14, 7.4), layout="constrained")
    shown = {"What it is": sweep.classes - 1, "What it says": network.says(features(sweep))}
    for axes, (title, rows) in zip(figure.subplots(1, 2), shown.items(), strict=True):
        dots = axes.scatter(*sweep.points[:, :2].T, s=1, c=rows, cmap=COLORS, vmin=-0.5, vmax=3.5)
        axes.set(xlim=(-40, 40), ylim=(-40, 40), aspect="equal", title=title, xlabel="m")
    figure.legend(dots.legend_elements()[0], CLASSES, loc="outside lower center", ncols=4)
    figure.savefig("tell-apart.png", dpi=120)


if __name__ == "__main__":
    main(*sys.argv[1:])
