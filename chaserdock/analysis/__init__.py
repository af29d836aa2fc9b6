"""What a log says about a flight."""
