"""Markers in a picture to the pose of the target (ArUco, fitted sides, PnP with covariance)."""

from chaserdock_agents.perception.estimate import Method, Perception, PoseSolution, Sighting

__all__ = ["Method", "Perception", "PoseSolution", "Sighting"]
