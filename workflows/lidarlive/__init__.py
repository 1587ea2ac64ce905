"""Programs that send and receive sweeps while they run."""
