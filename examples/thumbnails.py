"""Thumbnails: decode on CPU workers, shrink on GPU workers, write in order on one more.

``python examples/thumbnails.py out.npy``. The pictures are noise: put your own `decode` and
`shrink` in their place. The pipe bounds how far decoding runs ahead of writing.
"""

import argparse
import uuid
from pathlib import Path

import numpy as np
from distributed import Client, LocalCluster, secede

from poolpart import Pipe, Pool


def decode(number):
    return np.random.default_rng(number).integers(0, 256, (240, 320, 3), np.uint8)


def shrink(picture, factor=8):
    height, width, colours = picture.shape
    blocks = picture.reshape(height // factor, factor, width // factor, factor, colours)
    return blocks.mean(axis=(1, 3)).astype(np.uint8)


def write(inlet: Pipe, path: Path):
    secede()  # it mostly waits: leave the worker's thread to others
    try:
        np.save(path, thumbnails := [future.result() for future in inlet])
    except BaseException as error:
        inlet.fail(f"writing {path} failed: {error}")  # or the other end would wait for ever
        raise
    return len(thumbnails)


def run(client: Client, path: Path, count: int):
    gpu, rest = Pool.from_client(client).partition("GPU", max_workers_per_gpu=1)
    writer, rest = rest.partition("WRITER", n_workers=1)
    cpu, _ = rest.partition("CPU", workers=rest.names)
    print(gpu, writer, cpu, sep="\n")
    pipe = Pipe(f"thumbnails-{uuid.uuid4().hex}", capacity=8, client=client).create()
    try:
        written = writer.submit(write, pipe, path)
        for number in range(count):
            pipe.put(gpu.submit(shrink, cpu.submit(decode, number)))
        pipe.close()
        print(f"{written.result()} thumbnails in {path}")
    finally:
        pipe.delete()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("path", type=Path)
    parser.add_argument("--count", type=int, default=24)
    given = parser.parse_args()
    options = {"n_workers": 4, "threads_per_worker": 1, "host": "127.0.0.1"}
    with LocalCluster(**options, dashboard_address="127.0.0.1:0") as cluster:
        run(cluster.get_client(), given.path.absolute(), given.count)
