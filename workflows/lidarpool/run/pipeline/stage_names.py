"""Names of the stages, and of the partitions on which they run."""

GPU = "GPU"
LIDAR = "LIDAR"
OTHER = "OTHER"

GENERATE = "generate"  # stage 1, a long-running task on LIDAR
INTERSECT = "intersect"  # stage 2, short tasks on GPU that cast batches
SORT = "sort"  # stage 3, a long-running task on LIDAR
COLLECT = "collect"  # stage 4, several long-running tasks on LIDAR (`collectors`)
EXPORT = "export"  # short tasks on LIDAR that write jobs or ranges of files
