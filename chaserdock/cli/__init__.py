# SPDX-License-Identifier: Apache-2.0
"""The commands of the ``chaserdock`` program, one module per topic; ``main`` assembles them."""
