"""Work that goes item by item, in processes on this machine or on a cluster."""
