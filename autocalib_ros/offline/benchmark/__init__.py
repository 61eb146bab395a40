"""Benchmarks: accuracy by Monte Carlo, processor time and memory, and regression on golden evidence."""
