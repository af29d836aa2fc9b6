# SPDX-License-Identifier: Apache-2.0
"""Reproduction of the paper's table and missions."""
