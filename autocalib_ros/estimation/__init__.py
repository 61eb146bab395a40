"""Observations to geometry: numpy and scipy only; no image, file or ROS is seen here."""
