"""Follow simulators that are running, and publish simulated sensors next to them."""
