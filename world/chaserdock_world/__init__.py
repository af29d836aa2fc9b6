# SPDX-License-Identifier: Apache-2.0
"""The simulated world: PyBullet physics, cameras, ground truth."""
