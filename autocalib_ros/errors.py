"""Exceptions for wrong usage and unreadable input. Insufficient evidence is a Refusal, a value, not an exception."""

from __future__ import annotations


class AutocalibError(Exception):
    """Base class of all exceptions raised on purpose; the message is one line."""


class UsageError(AutocalibError):
    """An option or argument is invalid."""


class InputError(AutocalibError):
    """A file, recording or image cannot be read."""
