"""Camera calibration and printable marker sheets."""
