"""Read YAML and JSON documents of unknown origin: size, depth, aliases and numbers are limited before they cost memory.

Errors are InputError with one line, without the name of the file where only text is given.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar, NoReturn

import yaml

from autocalib_ros.errors import InputError
from autocalib_ros.util.input_limits import (
    MAX_DEPTH,
    MAX_DOCUMENT_BYTES,
    MAX_INTEGER,
    MAX_NODES,
    MAX_NUMBER_CHARACTERS,
)

TIMESTAMP_TAG = 'tag:yaml.org,2002:timestamp'
ERROR_CHARACTERS = 200
"""Most characters of the reason of a library."""


def read_bytes(path: Path, what: str, limit: int = MAX_DOCUMENT_BYTES) -> bytes:
    """Return the content of a file; InputError if it cannot be read or is longer than `limit` bytes."""
    try:
        with path.open('rb') as stream:
            content = stream.read(limit + 1)
    except (OSError, ValueError) as error:
        raise InputError(f'cannot read {path}: {getattr(error, "strerror", None) or error}') from error
    if len(content) > limit:
        raise InputError(f'{path}: it is longer than {limit} bytes, so it is no {what}')
    return content


def read_text(path: Path, what: str, limit: int = MAX_DOCUMENT_BYTES) -> str:
    """Return the text of a file in UTF-8 without a byte order mark; InputError as of `read_bytes`, or if it is none."""
    try:
        return read_bytes(path, what, limit).decode('utf-8-sig')
    except UnicodeDecodeError as error:
        raise InputError(f'{path}: it is no text in UTF-8, so it is no {what} ({error.reason})') from error


def read_yaml(path: Path, what: str, limit: int = MAX_DOCUMENT_BYTES) -> Any:
    """Return the document in a YAML file; InputError names the file and the reason."""
    content = read_bytes(path, what, limit)
    try:
        return parse_yaml(content)
    except InputError as error:
        raise InputError(f'{path} {error}') from error


def parse_yaml(content: str | bytes, *, first: bool = False) -> Any:
    """Return the only document of a text in YAML, with `first` the first of several; None if there is none.

    Dates stay text. InputError begins with 'is not YAML' or says which limit the text exceeds.
    """
    loader = None
    try:
        loader = _LimitedLoader(content)
        loader.first = first
        return loader.get_single_data()
    except InputError:
        raise
    except Exception as error:  # PyYAML raises errors of any type at unknown tags and malformed numbers
        reason = printable(' '.join(str(error).split()))[:ERROR_CHARACTERS]
        raise InputError(f'is not YAML ({reason or type(error).__name__})') from error
    finally:
        if loader is not None:
            loader.dispose()


class _LimitedLoader(yaml.SafeLoader):
    """The safe loader without dates, which stops at documents that are deeper or larger than any of ours."""

    yaml_implicit_resolvers: ClassVar = {
        start: [(tag, pattern) for tag, pattern in found if tag != TIMESTAMP_TAG]
        for start, found in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    first = False
    _depth = 0

    def get_single_node(self) -> Any:
        if not self.first:
            return super().get_single_node()
        self.get_event()  # of the stream
        return None if self.check_event(yaml.StreamEndEvent) else self.compose_document()

    def compose_node(self, parent: Any, index: Any) -> Any:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise InputError(f'has more than {MAX_DEPTH} levels')
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_document(self, node: Any) -> Any:
        _count_nodes(node, {})
        return super().construct_document(node)

    def construct_scalar(self, node: Any) -> Any:
        text = super().construct_scalar(node)
        _require_characters(text)
        return text

    def construct_limited_int(self, node: Any) -> int:
        """Return a whole number that is a float too."""
        _require_short(node.value)
        return _limited(self.construct_yaml_int(node))

    def construct_limited_float(self, node: Any) -> float:
        """Return a number."""
        _require_short(node.value)
        return float(self.construct_yaml_float(node))


_LimitedLoader.add_constructor('tag:yaml.org,2002:int', _LimitedLoader.construct_limited_int)
_LimitedLoader.add_constructor('tag:yaml.org,2002:float', _LimitedLoader.construct_limited_float)


def _count_nodes(node: Any, counted: dict[int, int | None]) -> int:
    """Return the number of nodes below a node, aliases written out; InputError if there are too many, or a circle."""
    if id(node) in counted:
        count = counted[id(node)]
        if count is None:
            raise InputError('has an alias that contains itself')
        return count
    counted[id(node)] = None
    count = 1 + sum(_count_nodes(child, counted) for child in _children(node))
    if count > MAX_NODES:
        raise InputError(f'has more than {MAX_NODES} values, aliases written out')
    counted[id(node)] = count
    return count


def _children(node: Any) -> Iterator[Any]:
    if isinstance(node, yaml.SequenceNode):
        yield from node.value
    elif isinstance(node, yaml.MappingNode):
        for pair in node.value:
            yield from pair


def read_json(path: Path, what: str, limit: int = MAX_DOCUMENT_BYTES) -> Any:
    """Return the document in a JSON file; InputError names the file and the reason."""
    content = read_bytes(path, what, limit)
    try:
        return parse_json(content)
    except InputError as error:
        raise InputError(f'{path}: it {error}') from error


def parse_json(content: str | bytes) -> Any:
    """Return a JSON document; InputError begins with 'is not JSON'.

    NaN and infinity, whole numbers beyond `MAX_INTEGER` and half characters (lone surrogates) are refused.
    """
    try:
        text = content.decode('utf-8-sig') if isinstance(content, bytes) else content
        document = json.loads(text, parse_constant=_reject_constant, parse_int=_parse_int, parse_float=_parse_float)
        _check_texts(document, MAX_DEPTH)
    except (ValueError, RecursionError, InputError) as error:
        raise InputError(f'is not JSON ({printable(str(error))[:ERROR_CHARACTERS]})') from error
    return document


def printable(text: str) -> str:
    """Return a text that can be printed and logged: half characters are written as their code."""
    return text.encode('utf-8', 'backslashreplace').decode('utf-8')


def _parse_int(text: str) -> int:
    _require_short(text)
    return _limited(int(text))


def _parse_float(text: str) -> float:
    value = float(text)
    if value in (float('inf'), float('-inf')):
        raise InputError(f'{text[:20]} is beyond every number')
    return value


def _limited(value: int) -> int:
    if not -MAX_INTEGER < value < MAX_INTEGER:
        raise InputError(f'has a whole number of {len(str(abs(value)))} digits; {len(str(MAX_INTEGER))} are possible')
    return value


def _require_short(text: str) -> None:
    if len(text) > MAX_NUMBER_CHARACTERS:
        raise InputError(f'has a number of {len(text)} characters; {MAX_NUMBER_CHARACTERS} are possible')


def _require_characters(text: Any) -> None:
    if isinstance(text, str) and not text.isascii():
        try:
            text.encode('utf-8')
        except UnicodeEncodeError as error:
            raise InputError('has a text with half a character (a lone surrogate)') from error


def _check_texts(value: Any, depth: int) -> None:
    if depth < 0:
        raise InputError(f'has more than {MAX_DEPTH} levels')
    if isinstance(value, dict):
        for name, item in value.items():
            _require_characters(name)
            _check_texts(item, depth - 1)
    elif isinstance(value, list):
        for item in value:
            _check_texts(item, depth - 1)
    else:
        _require_characters(value)


def _reject_constant(name: str) -> NoReturn:
    raise ValueError(f'{name} is no number')
