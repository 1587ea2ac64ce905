"""Decode images on CPU workers, shrink them on GPU workers, and append them to a file in order."""

import sys
import time
from pathlib import Path

import numpy as np
from distributed import Client, get_client

from poolpart import Pipe, Pool, n_workers, per_gpu, rest
from poolpart.fetch import fetch_available

SIZE = 30 * 40 * 3  # bytes of a thumbnail
WINDOW = 8  # thumbnails in flight


def decode(number):  # returns noise; replace decode and shrink with your own functions
    return np.random.default_rng(number).integers(0, 256, (240, 320, 3), np.uint8)


def shrink(picture):
    return picture.reshape(30, 8, 40, 8, 3).mean(axis=(1, 3)).astype(np.uint8)


def write(keys, written, path):
    with path.open("ab", buffering=0) as file:  # an earlier writer may have died with its keys
        written.put([file.truncate(file.tell() // SIZE * SIZE) // SIZE, "again"])
        for number, key in keys:
            if number == file.tell() // SIZE:  # otherwise, the thumbnail is sent again
                thumbnails = fetch_available(get_client(), [key])  # none if its worker has died
                file.write(b"".join(thumbnails.values()))
                written.put([file.tell() // SIZE, "" if thumbnails else "again"])


def run(client, path, total=24):
    rules = {"WRITER": n_workers(1), "GPU": per_gpu(1), "CPU": rest()}
    writer, gpu, cpu = Pool.from_client(client).divide(rules).values()
    pipes = [
        Pipe(f"{direction}-{client.id}", 2 * WINDOW, client) for direction in ("keys", "written")
    ]
    futures = {}  # {number: future of a thumbnail that is not written yet}
    written_count = 0
    sent = 0
    with pipes[0] as keys, pipes[1] as written:
        task = writer.submit(write, keys, written, path)
        while written_count < total and not task.done():
            for number in range(written_count + len(futures), min(written_count + WINDOW, total)):
                futures[number] = gpu.submit(shrink, cpu.submit(decode, number))
            while sent in futures and futures[sent].done():
                if error := futures[sent].exception():
                    keys.fail(f"picture {sent}: {error}")
                keys.put([sent, futures[sent].key])
                sent += 1
            for count, resend in written.drain():
                futures = {number: future for number, future in futures.items() if number >= count}
                written_count = max(written_count, count)
                sent = max(written_count, 0 if resend else sent)
            time.sleep(0.005)
        keys.close()
        task.result()


if __name__ == "__main__":
    with Client(n_workers=4, threads_per_worker=1, dashboard_address="127.0.0.1:0") as client:
        run(client, Path(sys.argv[1]).absolute())
