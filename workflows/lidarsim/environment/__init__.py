"""Environment of the current process: optional libraries, plug-ins, signals and notebooks."""
