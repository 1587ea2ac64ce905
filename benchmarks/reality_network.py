"""Compare the classes that a network assigns to simulated and to recorded sweeps.

    python -m benchmarks.reality_network FOLDER NETWORK [NAME ...]

FOLDER contains the recordings of `benchmarks.reality`, and NETWORK is a clone of
Shathe/3D-MiniNet. The network is 3D-MiniNet-tiny, which was trained on SemanticKITTI. It requires
PyTorch. Held-out sweeps are simulated as in `benchmarks.reality_effects`. The results are the share
of the cells of the network's images that have the same class in both sweeps, among the cells with a
point in both. For scale, each recorded sweep is also compared with the next recorded sweep. Sweeps
with exchanged intensities show whether the ranges or the intensities cause the differences.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import yaml

from lidarsim.numerics.arrays import AnyArray, Bools, Floats, Floats32, Ints

from .harness import argument_parser, write_results
from .reality import SOURCES, part_of
from .reality_twin import MAX_SWEEPS, Effects, HalfTwin, PairedPulses

_TRAINING = Path("pytorch_code/lidar-bonnetal/train")
_SEMANTIC = _TRAINING / "tasks/semantic"
_MODEL = _SEMANTIC / "models/3D-MiniNet-tiny"
_CLASSES = 20
_BLOCK = 4  # edge length of the blocks that the network groups, in cells
_NO_POINT = -1
_VARIANTS = {
    "no effects, as surfaces": Effects(range_noise=False, reflectance_spread=False, gaps=False),
    "gaps": Effects(range_noise=False, reflectance_spread=False),
    "without reflectance spread": Effects(reflectance_spread=False),
    "all, as in a run": Effects(),
}
# Assigns a class, or _NO_POINT, to each cell of the images of sweeps (n, 4): x, y, z, intensity.
Classify = Callable[[list[Floats]], list[Ints]]


def load_network(folder: Path) -> Classify:
    """Load the network, and return a function that classifies the cells of sweeps."""
    import torch

    settings = yaml.safe_load((folder / _MODEL / "arch_cfg.yaml").read_text())
    weights = {
        part: torch.load(folder / _MODEL / part, map_location="cpu", weights_only=True)
        for part in ("backbone", "segmentation_decoder", "segmentation_head")
    }
    parameters = settings["backbone"]
    for block, layer in (("block_1", "enc2"), ("block_2", "enc3")):  # one more than is stated
        names = {name.rpartition(".conv1.pointwise")[0] for name in weights["backbone"]}
        parameters[block] = sum(name.startswith(f"{layer}.") for name in names)
    backbone = _module(folder / _TRAINING / "backbones/3dmininet.py").Backbone(parameters)
    decoder = _module(folder / _SEMANTIC / "decoders/3dmininet.py").Decoder(
        settings["decoder"], {}, parameters["OS"], backbone.get_last_depth()
    )
    head = torch.nn.Sequential(torch.nn.Conv2d(decoder.get_last_depth(), _CLASSES, 3, padding=1))
    for module, part in zip((backbone, decoder, head), weights.values(), strict=True):
        module.load_state_dict(part)
        module.eval()
    sensor = settings["dataset"]["sensor"]

    def classify(sweeps: list[Floats]) -> list[Ints]:
        classes = []
        for features, mask in (network_input(sweep, sensor) for sweep in sweeps):
            image = torch.from_numpy(features)
            groups = torch.from_numpy(_blocks(features).reshape(len(features), _BLOCK**2, -1))
            with torch.no_grad():
                found, skips = backbone([image[None], groups[None]])
                scores = head(decoder(found, skips))[0].numpy()
            classes.append(np.where(mask, scores.argmax(axis=0), _NO_POINT))
        return classes

    return classify


def network_input(sweep: Floats, sensor: dict[str, Any]) -> tuple[Floats32, Bools]:
    """Return the features (11, h, w) of the cells of a sweep, and a mask of the cells with a point.

    The features of a cell are the range, the coordinates and the intensity of its nearest point,
    normalized, and relative to the mean of its block, and the distance from this mean.
    """
    values, mask = _project(sweep, sensor)
    means, stds = (np.array(sensor[name])[:, None, None] for name in ("img_means", "img_stds"))
    blocks, in_block = _blocks(values), _blocks(mask[None])
    mean = blocks.sum(axis=(1, 2)) / np.maximum(in_block.sum(axis=(1, 2)), 1)
    relative = np.where(in_block, blocks - mean[:, None, None], 0)
    relative = relative.transpose(0, 3, 1, 4, 2).reshape(values.shape)
    distance = np.linalg.norm(relative[1:4], axis=0, keepdims=True)
    features = np.concatenate([(values - means) / stds * mask, relative, distance])
    return features.astype(np.float32), mask


def _project(sweep: Floats, sensor: dict[str, Any]) -> tuple[Floats, Bools]:
    """Return the range, coordinates and intensity (5, h, w) of the nearest point in each cell.

    Also return a mask of the cells with a point.
    """
    height, width = sensor["img_prop"]["height"], sensor["img_prop"]["width"]
    range_m = np.linalg.norm(sweep[:, :3], axis=1)
    farthest_first = np.argsort(-range_m)
    range_m, sweep = range_m[farthest_first], sweep[farthest_first]
    lowest, highest = np.radians([sensor["fov_down"], sensor["fov_up"]])
    column = (1 - np.arctan2(sweep[:, 1], sweep[:, 0]) / np.pi) / 2 * width
    row = (highest - np.arcsin(sweep[:, 2] / range_m)) / (highest - lowest) * height
    cells = tuple(
        index.astype(np.int64).clip(0, size - 1) for index, size in ((row, height), (column, width))
    )
    values = np.zeros((5, height, width))
    values[:, *cells] = np.column_stack([range_m, sweep]).T
    mask = np.zeros((height, width), bool)
    mask[cells] = True
    return values, mask


def _blocks(image: AnyArray) -> AnyArray:
    """Divide an image (k, h, w) into blocks, and return them as (k, b, b, h / b, w / b)."""
    count, height, width = image.shape
    blocks = image.reshape(count, height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK)
    return blocks.transpose(0, 2, 4, 1, 3)


def _module(file: Path) -> ModuleType:
    """Import a module from a file."""
    spec = spec_from_file_location(file.stem, file)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def recorded_points(twin: HalfTwin, number: int) -> Floats:
    """Return the recorded points and intensities (n, 4) of a sweep."""
    sweep = twin.sweeps.recorded.read(number)
    intensity = np.zeros(len(sweep)) if sweep.intensity is None else sweep.intensity
    return np.column_stack([sweep.points, intensity])


def simulated_points(pulses: PairedPulses) -> Floats:
    """Return the simulated points (n, 4), with intensities on the scale of the recording."""
    both = np.isfinite(pulses.intensity) & np.isfinite(pulses.simulated_intensity)
    scale = pulses.intensity[both].mean() / pulses.simulated_intensity[both].mean()
    returned = np.isfinite(pulses.simulated_m)
    intensity = scale * pulses.simulated_intensity[returned]
    return np.column_stack([pulses.simulated_points[returned], intensity])


def exchange_intensities(
    recorded: Floats, simulated: Floats, pulses: PairedPulses
) -> tuple[Floats, Floats]:
    """Return the recorded and the simulated points (n, 4) with the intensities of each other.

    Points that only one of the sweeps has keep their intensity.
    """
    in_recorded, in_simulated = np.isfinite(pulses.range_m), np.isfinite(pulses.simulated_m)
    both = in_recorded & in_simulated
    recorded, simulated = recorded.copy(), simulated.copy()
    recorded_rows, simulated_rows = both[in_recorded], both[in_simulated]
    recorded[recorded_rows, 3], simulated[simulated_rows, 3] = (
        simulated[simulated_rows, 3],
        recorded[recorded_rows, 3],
    )
    return recorded, simulated


def agreement(first: Ints, second: Ints) -> float:
    """Return the share of cells with the same class, among those with a point in both images."""
    both = (first != _NO_POINT) & (second != _NO_POINT)
    return float((first == second)[both].mean())


def measure(name: str, folder: Path, classify: Classify) -> list[dict[str, Any]]:
    """Print and return a row for each kind of sweep that is compared with the recorded sweeps."""
    source = SOURCES[name]
    recording = part_of(source.open(folder / source.repository), slice(-MAX_SWEEPS, None))
    twin = HalfTwin.from_recording(recording)
    numbers = twin.held_out.tolist()
    recorded = [recorded_points(twin, number) for number in numbers]
    # The last sweep has no next sweep, so the previous one is used.
    neighbors = [number + 1 if number + 1 < len(recording) else number - 1 for number in numbers]
    compared = {"next recorded sweep": [recorded_points(twin, number) for number in neighbors]}
    for variant, effects in _VARIANTS.items():
        pulses = list(twin.simulate(twin.effective(effects)))
        compared[variant] = list(map(simulated_points, pulses))
    exchanged = map(exchange_intensities, recorded, compared[variant], pulses)
    of_recorded, of_simulated = zip(*exchanged, strict=True)
    compared["recorded points, simulated intensities"] = list(of_recorded)
    compared["simulated points, recorded intensities"] = list(of_simulated)
    classes = classify(recorded)
    rows = []
    for variant, sweeps in compared.items():
        shares = list(map(agreement, classify(sweeps), classes))
        rows.append({"recording": name, "compared": variant, "agreement": shares})
        print(f"{name}: {variant}: {np.mean(shares):.1%}, worst sweep {min(shares):.1%}")
    return rows


def main(arguments: list[str] | None = None) -> list[dict[str, Any]]:
    """Measure the recordings in a folder, and print and return the rows."""
    parser = argument_parser(__doc__)
    parser.add_argument("folder", type=Path, help="folder that contains the repositories")
    parser.add_argument("network", type=Path, help="clone of Shathe/3D-MiniNet")
    names = ("kitti360", "udacity")
    parser.add_argument("names", nargs="*", default=names, help=f"default: {', '.join(names)}")
    options = parser.parse_args(arguments)
    classify = load_network(options.network)
    rows = [row for name in options.names for row in measure(name, options.folder, classify)]
    write_results(options.json, rows)
    return rows


if __name__ == "__main__":
    main()
