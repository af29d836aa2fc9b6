"""Campaigns: seeded runs of a scenario, planned, flown, tabulated and reported."""
