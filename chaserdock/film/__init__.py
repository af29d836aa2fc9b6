# SPDX-License-Identifier: Apache-2.0
"""Path-traced films (optional: extra ``film``): the entry is `frames.PathTracedBodies`."""
