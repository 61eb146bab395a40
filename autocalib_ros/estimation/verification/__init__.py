"""Acceptance: readiness, identifiability, consistency, gates, scale."""
