"""Many seeded runs of one scenario: planned, flown, gathered in a table, reported."""
