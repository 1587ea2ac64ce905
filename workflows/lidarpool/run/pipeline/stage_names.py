"""Names of the stages and of the partitions that they run on, in a leaf module."""

GPU = "GPU"
LIDAR = "LIDAR"
OTHER = "OTHER"

GENERATE = "generate"  # 1, on LIDAR: one long task
INTERSECT = "intersect"  # 2, on GPU: a short task for each batch
SORT = "sort"  # 3, on LIDAR: one long task
COLLECT = "collect"  # 4, on LIDAR: two long tasks
EXPORT = "export"  # runs on LIDAR, after the survey: a short task for each range of files
