"""Pedestrians and cyclists, classified by metric size and speed."""
