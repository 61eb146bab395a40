"""Lens and plane from vehicles that turn or change lanes."""
