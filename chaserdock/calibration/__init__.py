"""Tools round the cameras: marker sheets and calibration."""
