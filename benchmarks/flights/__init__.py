# SPDX-License-Identifier: Apache-2.0
"""Closed loops and drawn scenarios that benchmarks and tests share."""
