"""Text for terminals, files and fonts that have ASCII only."""

from __future__ import annotations

IN_ASCII = {'±': '+-', '·': '.', '°': ' degrees', '²': '^2', '…': '...', '→': '->'}
"""What stands for a character."""


def in_ascii(text: str) -> str:
    """Return a text with ASCII characters only; a question mark stands for what has no other form."""
    return ''.join(each if each.isascii() else IN_ASCII.get(each, '?') for each in text)
