"""Exceptions for wrong usage and unreadable input. Insufficient evidence is a Refusal, a value, not an exception."""

from __future__ import annotations


class AutocalibError(Exception):
    """Base class of all exceptions raised on purpose; the message is one line.

    What cannot be printed (from names and values of damaged files) is written as its code.
    """

    def __init__(self, message: str = '') -> None:
        super().__init__(message if message.isprintable() else ''.join(map(_printable, message)))


def _printable(character: str) -> str:
    return character if character.isprintable() else character.encode('unicode_escape').decode()


class UsageError(AutocalibError):
    """An option or argument is invalid."""


class InputError(AutocalibError):
    """A file, recording or image cannot be read."""
