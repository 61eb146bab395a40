"""Write config/autocalib.yaml anew from the options: python tests/tools/write_params_file.py."""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from autocalib_ros.config import RECONFIGURABLE, NodeOptions, Options

HEAD = """\
# Every option of autocalib_ros with its default: what it does, and what it may be.
#
#   autocalib_node --ros-args --params-file autocalib.yaml -p camera_height:=8.0
#   autocalib replay BAG --params-file autocalib.yaml --camera-height 8.0
#
# Copy the file and keep only the lines that you change. An unknown name is an error. A number with a point
# stays one with a point: ROS refuses 8 where 8.0 is meant. The file has to stand before every -p that is to win.
#
{changes}

/**:
  ros__parameters:"""
CHANGES = 'While a node runs, `ros2 param set` changes these options and groups, and a solution follows at once:'
FIXED = 'All else shapes the evidence from the first image on, or names what others rely on, and is read-only.'
WIDTH = 118


def lines_of(options: Any, indent: str) -> Iterator[str]:
    """Yield the lines of an option dataclass, each option under what it does and may be."""
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
    """Say which values an option takes."""
    low, high = meta['low'], meta['high']
    if meta['choices']:
        return f' One of: {", ".join(meta["choices"])}.'
    if low is not None and high is not None:
        return f' {low} to {high}.'
    if low is not None:
        return f' At least {low}.'
    return '' if high is None else f' At most {high}.'


def as_yaml(value: Any) -> str:
    """Write a value so that YAML and ROS read the same type back."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        text = f'{value:f}'.rstrip('0')
        return text + '0' if text.endswith('.') else text
    return repr(value)


def first_line(options: Any) -> str:
    """Return what an option dataclass is about."""
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
