"""Calibrate a fixed roadside camera from the traffic that it sees."""

__version__ = '0.1.0'
