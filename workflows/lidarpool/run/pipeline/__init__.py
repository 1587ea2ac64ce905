"""The survey pipeline: four stages on the partitions of a cluster, and their driver."""
