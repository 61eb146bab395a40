"""Lens and plane from lane markings: line segments, grid mixture, grid search."""
