"""Offline shell: recordings in, files and reports out; benchmarks, and a simulator with ground truth."""
