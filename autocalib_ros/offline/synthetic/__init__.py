"""Synthetic evidence without images: junctions, trajectories, disturbances."""
