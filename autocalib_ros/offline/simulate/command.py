"""`autocalib simulate`: command line of the simulator."""

from __future__ import annotations

import argparse
import re
from dataclasses import MISSING, fields
from typing import Any

from autocalib_ros.errors import UsageError
from autocalib_ros.offline.simulate.options import SCENES, SHUTTER_SHOWS, STORAGES, SimulationOptions

_UNIT = re.compile(r'_(px|deg|m|s|hz)$')
_CUSTOM_OPTIONS = ('width_px', 'height_px', 'k')
_PAIRS = {'principal_point_offset_px': ('DX', 'DY'), 'position_m': ('X', 'Y')}
_CHOICES = {'scene': SCENES, 'storage': STORAGES, 'shutter_shows': SHUTTER_SHOWS}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the bag argument and one option per field of SimulationOptions."""
    parser.add_argument('bag', metavar='BAG', help='rosbag2 folder to write')
    _add_lens_and_size(parser)
    for field in fields(SimulationOptions):
        if field.name not in _CUSTOM_OPTIONS:
            _add_option(parser, field.name, field.type, field.default, field.metadata['help'])
    parser.add_argument(
        '--workers', type=int, metavar='N', help='number of rendering processes (default: one per core)'
    )
    parser.add_argument('--overwrite', action='store_true', help='replace an existing bag')


def options_from(args: argparse.Namespace) -> SimulationOptions:
    """Return the options of the arguments; options not given keep their defaults."""
    given = {field.name: getattr(args, field.name) for field in fields(SimulationOptions) if hasattr(args, field.name)}
    if hasattr(args, 'size'):
        given['width_px'], given['height_px'] = args.size
    k = list(SimulationOptions.k)
    for i in range(4):
        k[i] = getattr(args, f'k{i + 1}', k[i])
    for name in _PAIRS:
        if given.get(name) is not None:
            given[name] = tuple(given[name])
    return SimulationOptions(**{**given, 'k': tuple(k)})


def run(args: argparse.Namespace) -> int:
    """Write the bag; return the exit status."""
    from autocalib_ros.offline.simulate.bag import TRUTH_FILE_NAME, write_bag
    from autocalib_ros.offline.terminal.progress import progress_bar

    options = options_from(args)
    with progress_bar(options.frame_count, unit='frame', label='simulating') as bar:
        path = write_bag(
            args.bag,
            options,
            workers=args.workers,
            overwrite=args.overwrite,
            progress=lambda done, total: bar.update_to(done),
        )
    print(f'wrote {path} and {path / TRUTH_FILE_NAME}')
    return 0


def _add_lens_and_size(parser: argparse.ArgumentParser) -> None:
    size = f'{SimulationOptions.width_px}x{SimulationOptions.height_px}'
    parser.add_argument(
        '--size',
        type=_size,
        metavar='WxH',
        default=argparse.SUPPRESS,
        help=f'image size (default {size})',
    )
    for i, default in enumerate(SimulationOptions.k, 1):
        parser.add_argument(
            f'--k{i}',
            type=float,
            default=argparse.SUPPRESS,
            metavar='K',
            help=f'lens coefficient of theta^{2 * i + 1} (default {default:g})',
        )


def _add_option(parser: argparse.ArgumentParser, name: str, kind: Any, default: Any, text: str) -> None:
    """Add one option; its flag is the field name without the unit."""
    flag = '--' + _UNIT.sub('', name).replace('_', '-')
    if default is MISSING:
        raise TypeError(f'option {name} has no default')
    settings: dict[str, Any] = {'dest': name, 'default': argparse.SUPPRESS, 'help': text}
    if isinstance(default, bool):
        parser.add_argument(flag, action='store_true', **settings)
        return
    if default is not None:
        shown = ' '.join(map(str, default)) if isinstance(default, tuple) else default
        settings['help'] = f'{text} (default {shown})'
    if name in _PAIRS:
        settings |= {'nargs': 2, 'metavar': _PAIRS[name], 'type': float}
    elif name in _CHOICES:
        settings |= {'choices': _CHOICES[name]}
    else:
        settings |= {'type': _type_of(kind), 'metavar': flag[2:].upper()}
    parser.add_argument(flag, **settings)


def _type_of(kind: Any) -> type:
    """Return the type of an annotation such as 'float | None'."""
    return {'int': int, 'float': float, 'str': str}[str(kind).split(' | ')[0]]


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r'(\d+)x(\d+)', text)
    if match is None:
        raise UsageError(f'size {text!r} is not WxH: write it like 1280x720')
    return int(match[1]), int(match[2])
