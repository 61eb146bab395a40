"""Results as values and as files: calibration, its JSON, saved cameras and the store."""
