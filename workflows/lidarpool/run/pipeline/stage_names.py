"""Names of the stages and of the partitions that they run on."""

GPU = "GPU"
LIDAR = "LIDAR"
OTHER = "OTHER"

GENERATE = "generate"  # 1, on LIDAR: one long task
INTERSECT = "intersect"  # 2, on GPU: a short task for each batch
SORT = "sort"  # 3, on LIDAR: one long task
COLLECT = "collect"  # 4, on LIDAR: `collectors` long tasks, two by default
EXPORT = "export"  # on LIDAR: short tasks that write jobs, or ranges of the files of a survey
