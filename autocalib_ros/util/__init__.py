"""Small helpers without any knowledge of calibration: files and threads."""
