"""The processes around the world: chasers, recorder, launcher, analysis, command line."""
