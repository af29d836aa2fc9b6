# SPDX-License-Identifier: Apache-2.0
"""The simulated world: physics, cameras, ground truth."""
