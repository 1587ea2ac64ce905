"""Pipeline with four stages on the partitions of a cluster, and the driver that controls it."""
