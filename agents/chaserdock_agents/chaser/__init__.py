"""The chaser process: sees the target through its camera and drives its actuators."""
