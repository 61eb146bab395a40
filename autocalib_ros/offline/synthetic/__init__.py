"""Synthetic evidence without images: junctions, drives, disturbances."""
