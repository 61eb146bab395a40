"""Visualisation of a calibration on camera images, with OpenCV: overlays, top views and undistorted views."""
