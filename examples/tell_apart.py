"""Learns to tell ground, buildings and cars apart: a campaign of streets, a network in NumPy.

    python tell_apart.py [FOLDER]

It makes a data set of 30 cities in FOLDER, if there is none, reads it sweep by sweep, trains a
network of three layers in a minute on one core, and draws what it says of a city that it has never
seen into tell-apart.png.
"""

import sys
import time
from pathlib import Path

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

import lidarpool
from lidarpool import Campaign, CampaignJob, Material, Pose, Survey, load_sensor
from lidarpool.scene.city import city

CLASSES = ("ground", "building", "car", "tree or lamp")  # 1 to 4 in the column `class`
COLOURS = ("#b9bfc7", "#4477aa", "#ee7733", "#44aa77")
FINE, COARSE = 0.4, 2.0  # sides of cells around a point, metres
HIDDEN, BATCH, EPOCHS, RATE = (64, 32), 1024, 6, 2e-3


def street(number, rng):
    """Make a job: three sweeps in a city of its own, with more or fewer cars, trees and haze."""
    values = {
        "cars": int(rng.integers(40, 110)),
        "trees": int(rng.integers(10, 100)),
        "visibility_km": round(float(np.exp(rng.uniform(np.log(0.1), np.log(10)))), 3),
    }
    scene = city(40_000, seed=number, cars=values["cars"], trees=values["trees"])
    at = np.column_stack([rng.uniform(-40, 40, 3), rng.uniform(-3, 3, 3), np.full(3, 1.9)])
    survey = Survey(
        sensor=load_sensor("ouster/os1-32"),
        poses=[Pose(tuple(place), yaw_deg=float(rng.uniform(-180, 180))) for place in at],
        materials=[
            Material("*", 0.45, semantic_class=4),  # of the entries for an object the last counts
            Material(["ground", "pavement"], 0.3, semantic_class=1),
            Material("building-*", 0.4, semantic_class=2),
            Material(["Saloon*", "Estate*", "Panel van*"], 0.5, semantic_class=3),
        ],
        visibility_km=values["visibility_km"],
        keep_every=1,
        columns=["intensity", "class"],
    )
    return CampaignJob(scene, survey, values)


def features(points, intensity):
    """What the network sees of each point, (n, 17): the point, its column of air, its surface."""
    x, y, z = points.T
    away = np.hypot(x, y)
    out = [z, np.log1p(away), np.log(intensity * (away**2 + z**2) + 1e-3)]
    for side in (FINE, COARSE):  # columns of cells: how high things are, and the lowest of all
        cell = np.floor(points[:, :2] / side).astype(np.int64)
        cell -= cell.min(axis=0) - 1
        wide = cell.max(axis=0) + 2
        flat = cell @ (wide[1], 1)
        lowest, highest = np.full(wide.prod(), np.inf), np.full(wide.prod(), -np.inf)
        np.minimum.at(lowest, flat, z)
        np.maximum.at(highest, flat, z)
        around = [flat + step * wide[1] + aside for step in (-1, 0, 1) for aside in (-1, 0, 1)]
        ground = np.min([lowest[near] for near in around], axis=0)
        out += [z - ground, highest[flat] - z, highest[flat] - lowest[flat]]
        out += [np.max([highest[near] for near in around], axis=0) - ground]
    for side in (FINE, COARSE):  # boxes: the shape of the points within, by their covariance
        _, box = np.unique(np.floor(points / side).astype(np.int64), axis=0, return_inverse=True)
        box, count = box.ravel(), np.bincount(box.ravel()).astype(float)
        mean = np.stack([np.bincount(box, axis) for axis in points.T], axis=1) / count[:, None]
        off = points - mean[box]
        products = [np.bincount(box, off[:, i] * off[:, j]) for i in range(3) for j in range(3)]
        spread, ways = np.linalg.eigh(np.stack(products, axis=1).reshape(-1, 3, 3))
        upright = np.abs(ways[:, 2, 0])  # of the normal: 1 on the ground, 0 on a wall
        least, middle, most = np.sqrt(np.maximum(spread, 0) / count[:, None]).T
        shape = [upright, least / side, (middle - least) / (most + 1e-6)]
        out += [one[box] for one in shape]
    return np.stack(out, axis=1).astype(np.float32)


def read(place, split, share=1.0):
    """Features and classes of the points of a split, or of a random share of each sweep."""
    rng, seen, labels = np.random.default_rng(0), [], []
    for sweep in lidarpool.sweeps(place, split=split):
        some = rng.random(len(sweep)) < share
        seen.append(features(sweep.points.astype(float), sweep.intensity)[some])
        labels.append(sweep.classes[some] - 1)
    return np.concatenate(seen), np.concatenate(labels)


class Network:
    """Layers of rectified linear units, and shares of the classes at the end."""

    def __init__(self, widths, rng):
        self.weights = []
        for before, after in zip(widths, widths[1:], strict=False):
            self.weights += [rng.normal(0, np.sqrt(2 / before), (before, after)), np.zeros(after)]
        self.momenta = [[np.zeros_like(w) for w in self.weights] for _ in range(2)]
        self.steps = 0

    def layers(self, x):
        """Return what each layer gives, from the input to the logits."""
        out = [x]
        for k in range(0, len(self.weights), 2):
            x = out[-1] @ self.weights[k] + self.weights[k + 1]
            out.append(x if k == len(self.weights) - 2 else np.maximum(x, 0))
        return out

    def learn(self, x, label, weight, rate):
        """Take a step of Adam (Kingma and Ba, 2015) down the weighted cross-entropy."""
        *hidden, logits = self.layers(x)
        share = np.exp(logits - logits.max(axis=1, keepdims=True))
        share /= share.sum(axis=1, keepdims=True)
        share[np.arange(len(x)), label] -= 1
        back, gradients = share * (weight / weight.sum())[:, None], []
        for k in range(len(self.weights) - 2, -1, -2):
            gradients = [hidden[k // 2].T @ back, back.sum(axis=0), *gradients]
            back = back @ self.weights[k].T * (hidden[k // 2] > 0)
        self.steps += 1
        for w, g, first, second in zip(self.weights, gradients, *self.momenta, strict=True):
            first += 0.1 * (g - first)
            second += 0.001 * (g * g - second)
            mean, scale = first / (1 - 0.9**self.steps), second / (1 - 0.999**self.steps)
            w -= rate * mean / (np.sqrt(scale) + 1e-8)


def main(place):
    if not Path(place, "jobs.csv").exists():
        shares = {"train": 0.7, "val": 0.1, "test": 0.2}
        Campaign(street, 30, seed=1, splits=shares, title="Streets").run(place)
    begun, rng = time.monotonic(), np.random.default_rng(2)
    x, label = read(place, "train", share=0.4)
    mean, scale = x.mean(axis=0), x.std(axis=0)
    network = Network((x.shape[1], *HIDDEN, len(CLASSES)), rng)
    rare = 1 / np.sqrt(np.bincount(label, minlength=len(CLASSES)))  # rare classes count more
    steps = EPOCHS * (len(x) // BATCH)
    for step in range(steps):
        some = rng.integers(len(x), size=BATCH)
        network.learn((x[some] - mean) / scale, label[some], rare[label[some]], RATE * (1 - step / steps))
    print(f"{len(x):,} points of training, {time.monotonic() - begun:.0f} s")

    def say(x):
        return network.layers((x - mean) / scale)[-1].argmax(axis=1)

    for split in ("val", "test"):
        x, label = read(place, split)
        table = np.bincount(4 * label + say(x), minlength=16).reshape(4, 4)
        print(f"{split}: {len(x):,} points, {table.trace() / len(x):.1%} right")
    print("\n  of all that is …   … says " + "".join(f"{name:>14}" for name in CLASSES))
    for name, row in zip(CLASSES, table, strict=True):
        print(f"{name:>26}  " + "".join(f"{n / max(row.sum(), 1):>14.1%}" for n in row))
    both = np.diag(table) / (table.sum(axis=0) + table.sum(axis=1) - np.diag(table))
    print(f"{'intersection over union':>26}  " + "".join(f"{one:>14.1%}" for one in both))

    sweep = lidarpool.sweeps(place, split="test")[0]
    said = say(features(sweep.points.astype(float), sweep.intensity))
    figure = Figure((14, 7), layout="constrained")
    for axes, shown, title in zip(
        figure.subplots(1, 2), (sweep.classes - 1, said), ("is", "says"), strict=True
    ):
        axes.scatter(*sweep.points[:, :2].T, s=0.4, c=shown, cmap=ListedColormap(COLOURS), vmin=-0.5, vmax=3.5)
        axes.set(xlim=(-40, 40), ylim=(-40, 40), aspect="equal", title=title)
    figure.savefig("tell-apart.png", dpi=150)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "streets")
