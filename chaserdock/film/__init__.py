# SPDX-License-Identifier: Apache-2.0
"""Path-traced images (optional: extra ``film``). The entries are `frames.PathTracedBodies` for
films and `camera_images.path_tracing` for datasets.
"""
