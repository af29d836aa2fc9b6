"""Studies of the controller by itself: the flight code as it is, without pictures and without processes."""
