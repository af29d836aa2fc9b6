# SPDX-License-Identifier: Apache-2.0
"""Campaigns: seeded runs of a scenario, planned, flown, tabulated and reported."""
