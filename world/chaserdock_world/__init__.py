"""The simulated world: PyBullet physics, cameras, ground truth."""
