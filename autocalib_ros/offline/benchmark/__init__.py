"""Benchmarks: accuracy by Monte Carlo, cost, and golden evidence."""
