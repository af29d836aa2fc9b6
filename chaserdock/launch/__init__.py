"""Start, watch and judge missions; operator commands, status, keys."""
