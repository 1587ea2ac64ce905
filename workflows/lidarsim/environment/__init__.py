"""Optional libraries, plug-ins, signals, notebooks and network ports of the current process."""
