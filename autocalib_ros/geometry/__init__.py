"""Geometry that every layer shares: great circles, small matrices, robust kernels, the ground plane."""
