"""Start and stop workers depending on the load of their partitions.

    python examples/adaptive.py

In this example, jobs are processes on this machine. With `dask_jobqueue.SLURMCluster` and similar
classes, they are jobs in a queue.
"""

from dask_jobqueue.local import LocalCluster
from distributed import Client, get_worker

from poolpart import Partition
from poolpart.deploy import start_partitions


def worker_name(number: int) -> str:
    return str(get_worker().name)


if __name__ == "__main__":
    local = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
    with LocalCluster(cores=1, memory="1GB", scheduler_options=local) as cluster:
        partitions = {"GPU": {"adapt": [0, 2], "idle_s": 2}, "IO": {"adapt": [0, 2], "slots": 4}}
        start_partitions(cluster, partitions)
        with Client(cluster) as client:
            gpu = Partition("GPU", client)
            io = Partition("IO", client)
            print("workers:", len(gpu), len(io))
            names = set(gpu.map(worker_name, range(200)))
            print("200 tasks of GPU ran on", *sorted({name.partition("-")[0] for name in names}))
            print("workers of IO:", len(io))
