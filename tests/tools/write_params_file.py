"""Regenerate config/autocalib.yaml from the options: python tests/tools/write_params_file.py."""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from autocalib_ros.config import RECONFIGURABLE, NodeOptions, Options

HEAD = """\
# All options of autocalib_ros with default, meaning, unit and range.
#
#   autocalib_node --ros-args --params-file autocalib.yaml -p camera_height:=8.0
#   autocalib replay BAG --params-file autocalib.yaml --camera-height 8.0
#
# Copy the file and keep only the lines that you change. An unknown name is an error. Write floats with a decimal
# point: ROS rejects 8 for 8.0. Put --params-file before any -p that overrides it.
#
{changes}

/**:
  ros__parameters:"""
CHANGES = 'A running node accepts these options and groups by `ros2 param set` and solves again at once:'
FIXED = 'All others are read-only: they shape the evidence from the first image on, or name topics, frames and files.'
WIDTH = 118


def lines_of(options: Any, indent: str) -> Iterator[str]:
    """Yield the lines of an option dataclass, each option below its description and range."""
    for item in dataclasses.fields(options):
        value = getattr(options, item.name)
        if dataclasses.is_dataclass(value):
            yield ''
            yield f'{indent}# {first_line(value)}'
            yield f'{indent}{item.name}:'
            yield from lines_of(value, indent + '  ')
        else:
            doc = item.metadata['doc']
            text = f'{doc[0].upper()}{doc[1:]}.{permitted(item.metadata)}'
            yield from (f'{indent}# {line}' for line in textwrap.wrap(text, WIDTH - len(indent) - 2))
            yield f'{indent}{item.name}: {as_yaml(value)}'


def permitted(meta: Any) -> str:
    """Return the permitted values of an option as text."""
    low, high = meta['low'], meta['high']
    if meta['choices']:
        return f' One of: {", ".join(meta["choices"])}.'
    if low is not None and high is not None:
        return f' {low} to {high}.'
    if low is not None:
        return f' At least {low}.'
    return '' if high is None else f' At most {high}.'


def as_yaml(value: Any) -> str:
    """Return a value as YAML of the same type in ROS."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        text = f'{value:f}'.rstrip('0')
        return text + '0' if text.endswith('.') else text
    return repr(value)


def first_line(options: Any) -> str:
    """Return the first docstring line of an option dataclass."""
    return (type(options).__doc__ or '').splitlines()[0]


def document() -> str:
    """Return the whole file."""
    node = NodeOptions()
    wrapped = textwrap.wrap(f'{CHANGES} {", ".join(RECONFIGURABLE)}. {FIXED}', WIDTH - 2)
    head = HEAD.format(changes='\n'.join(f'# {line}' for line in wrapped))
    lines = [head, *lines_of(Options(), '    '), '', f'    # {first_line(node)}', *lines_of(node, '    ')]
    return '\n'.join(lines) + '\n'


if __name__ == '__main__':
    (Path(__file__).parents[2] / 'config' / 'autocalib.yaml').write_text(document(), encoding='utf-8')
