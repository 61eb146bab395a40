"""Lens and plane from a single straight road: a posterior over focal length, curvature and the turn about the road."""
