"""Misuse and unreadable input; "not enough evidence yet" is a value, never an exception."""

from __future__ import annotations


class AutocalibError(Exception):
    """Root of all errors the program raises on purpose; the message stands on one line."""


class UsageError(AutocalibError):
    """An option or argument that cannot be used as given."""


class InputError(AutocalibError):
    """A file, recording or image that cannot be read."""
