"""The simulator: scene, sensors and physics make returns, and those make columns."""
