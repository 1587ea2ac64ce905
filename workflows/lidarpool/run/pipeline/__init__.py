"""Pipeline whose four stages run on the partitions of a cluster, and its driver."""
