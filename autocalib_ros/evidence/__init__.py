"""Observations over time: a bounded buffer, frozen snapshots and their files."""
