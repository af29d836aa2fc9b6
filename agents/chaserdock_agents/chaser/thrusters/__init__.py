"""A chaser's thrusters: which of them give a wrench, when they open, and which of them have failed."""
