"""Rotation of the plane about a lone road from edges of vehicles."""
