# SPDX-License-Identifier: Apache-2.0
"""Reproduction of the paper's results: its flights, the statistics, and the page."""
