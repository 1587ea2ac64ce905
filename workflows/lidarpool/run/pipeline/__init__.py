"""The pipeline: four stages on the partitions of a cluster, and the rules of the driver."""
