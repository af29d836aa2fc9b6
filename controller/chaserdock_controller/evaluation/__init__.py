"""Studies of the controller by itself: the flight code as it is, without images and without processes."""
