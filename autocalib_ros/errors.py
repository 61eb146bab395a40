"""Exceptions for wrong usage and unreadable input. Insufficient evidence is a Refusal, a value, not an exception."""

from __future__ import annotations

MESSAGE_HEAD, MESSAGE_TAIL = 2000, 1000
"""Characters of a longer message that are kept of its beginning and of its end, where the remedy is: a name in a
damaged file can have megabytes."""


class AutocalibError(Exception):
    """Base class of all exceptions raised on purpose; the message is one line of at most about 3000 characters.

    What cannot be printed (from names and values of damaged files) is written as its code.
    """

    def __init__(self, message: str = '') -> None:
        super().__init__(printable_line(message))


def printable_line(text: str, head: int = MESSAGE_HEAD, tail: int = MESSAGE_TAIL) -> str:
    """Return a text of unknown origin as a line: what cannot be printed as its code, and of a long one both ends."""
    if len(text) > head + tail:
        text = f'{text[:head]} [{len(text) - head - tail} characters] {text[len(text) - tail :]}'
    return text if text.isprintable() else ''.join(map(_printable, text))


def _printable(character: str) -> str:
    return character if character.isprintable() else character.encode('unicode_escape').decode()


class UsageError(AutocalibError):
    """An option or argument is invalid."""


class InputError(AutocalibError):
    """A file, recording or image cannot be read."""
