"""Classes of 3D-MiniNet-tiny for the cells of sweeps: a part of `reality_network`.

`python reality_network_infer.py CLONE FOLDER RESULT.npz` runs in an environment with torch, scipy
and PyYAML, and without lidarpool. Network, weights and the projection to cells are the clone's.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
import yaml

_TRAIN = Path("pytorch_code/lidar-bonnetal/train")
_MODEL = Path("tasks/semantic/models/3D-MiniNet-tiny")
_WINDOW = 4  # edge of the groups of cells that the network reads


def _module(path: Path) -> ModuleType:
    """Import a file of the clone, whose name may be no identifier."""
    spec = importlib.util.spec_from_file_location(f"mininet_{path.parent.name}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def network(train: Path, arch: dict[str, Any], class_count: int) -> Any:
    """Return the network with its weights, as the clone's Segmentator assembles it."""
    shape = arch["dataset"]["sensor"]["img_prop"]
    height, width = shape["height"], shape["width"]
    names = ("backbone", "segmentation_decoder", "segmentation_head")
    weights = {
        name: torch.load(train / _MODEL / name, map_location="cpu", weights_only=True)
        for name in names
    }
    # The weights have the blocks of config/arch/3dmininet-tiny.yaml, one more than arch_cfg.yaml
    # states, by which the clone drops a block without a word.
    blocks = {key.split(".")[1] for key in weights["backbone"] if key.startswith("enc2.residual_")}
    params = arch["backbone"] | {"block_1": len(blocks)}
    backbone = _module(train / f"backbones/{params['name']}.py").Backbone(params=params)
    decoder = _module(train / f"tasks/semantic/decoders/{arch['decoder']['name']}.py").Decoder(
        params=arch["decoder"],
        stub_skips={},
        OS=params["OS"],
        feature_depth=backbone.get_last_depth(),
    )
    head = torch.nn.Sequential(
        torch.nn.Conv2d(decoder.get_last_depth(), class_count, kernel_size=3, padding=1)
    )
    for name, part in zip(names, (backbone, decoder, head), strict=True):
        part.load_state_dict(weights[name], strict=True)
        part.eval()

    def classes(image: Any, groups: Any) -> Any:
        features, skips = backbone([image[None], groups[None]])
        scores = head(decoder(features, skips))[0]
        assert scores.shape[1:] == (height, width)
        return scores.argmax(dim=0)

    return classes


def main(clone: Path, folder: str, result: str) -> None:
    """Write the classes (s, h, w) of sweeps, and the points in their cells, -1 for none."""
    train = clone / _TRAIN
    sys.path.insert(0, str(train))
    arch = yaml.safe_load((train / _MODEL / "arch_cfg.yaml").read_text())
    data = yaml.safe_load((train / _MODEL / "data_cfg.yaml").read_text())
    torch.Tensor.byte = torch.Tensor.bool  # the parser has bytes for masks, as torch once took
    parser = _module(train / "tasks/semantic/dataset/kitti/parser.py")
    sensor = arch["dataset"]["sensor"]
    sweeps = parser.SemanticKitti(
        folder,
        [0],
        data["labels"],
        data["color_map"],
        data["learning_map"],
        data["learning_map_inv"],
        sensor,
        arch["dataset"]["max_points"],
        gt=False,
        training=False,
    )
    classes_of = network(train, arch, len(data["learning_map_inv"]))
    shape = sensor["img_prop"]
    scan = sys.modules["common.laserscan"].LaserScan(
        True, shape["height"], shape["width"], sensor["fov_up"], sensor["fov_down"]
    )
    classes = []
    points = []
    with torch.no_grad():
        for number, file in enumerate(sweeps.scan_files):
            item = sweeps[number]
            classes.append(classes_of(item[0], item[-1]).numpy().astype(np.uint8))
            scan.open_scan(file)
            points.append(np.where(scan.proj_mask > 0, scan.proj_idx, -1))
    np.savez(result, classes=np.array(classes), points=np.array(points))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3])
