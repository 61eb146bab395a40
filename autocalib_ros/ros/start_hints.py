"""What is told at the start of the node: errors of rcl in plain words, and settings that have no effect."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from autocalib_ros.config import Options
from autocalib_ros.errors import InputError
from autocalib_ros.util.documents import read_yaml

PARAMS_FORM = "a parameter file has the form '/**: {ros__parameters: {camera_height: 8.0}}', with two underscores"
HINTS = (
    ('ros__parameters', PARAMS_FORM),
    ("Couldn't parse params file", PARAMS_FORM),
    ('Error opening YAML file', 'the file of --params-file does not exist or cannot be read'),
    ('remap', 'a remapping has the form -r from:=to'),
    ('Expected lexeme', 'a remapping has the form -r from:=to, a parameter -p name:=value'),
    ('parameter override', 'a parameter has the form -p name:=value'),
)
"""Words in errors of rcl, and what is meant."""
NO_SCALE = (
    'no camera height is given (camera_height), no distance (scale.distances), no speed (scale.speed_km_h) and no '
    'lanes (lanes.country): the lens is calibrated, and no ground plane is published'
)


def with_hint(text: str) -> str:
    """Return an error of rcl with what was probably meant."""
    hint = next((hint for words, hint in HINTS if words in text), '')
    return f'{text}; {hint}' if hint else text


def missing_scale(options: Options) -> str:
    """Return what is missing for a ground plane in metres; '' if nothing is."""
    return '' if options.gives_scale or options.allow_unit_scale else NO_SCALE


def unused_params_files(arguments: Sequence[str], node_name: str) -> list[str]:
    """Return a warning for each parameter file among the arguments that names no node of this full name."""
    files = [Path(value) for flag, value in itertools.pairwise(arguments) if flag == '--params-file']
    warnings = []
    for file in files:
        names = [name for name in _node_names(file) if name]
        if names and not any(_matches(name, node_name) for name in names):
            warnings.append(
                f'nothing of {file} is used: it is for {", ".join(sorted(names))}, and this node is {node_name}; '
                "'/**' is for every node"
            )
    return warnings


def _node_names(file: Path) -> list[str]:
    """Return the nodes that a parameter file has sections for; none if it cannot be read, which rcl tells."""
    try:
        return list(_sections(read_yaml(file, 'parameter file')))
    except InputError:
        return []


def _sections(tree: Any, name: str = '') -> Iterator[str]:
    for key, value in tree.items() if isinstance(tree, Mapping) else ():
        if key == 'ros__parameters':
            yield name
        else:
            yield from _sections(value, f'{name}/{key}'.replace('//', '/'))


def _matches(pattern: str, node_name: str) -> bool:
    """Whether a name with the wildcards * (one part) and ** (any parts) of rcl is that of a node."""
    parts = {'**': '.*', '*': '[^/]*'}
    whole = ''.join(parts.get(part, re.escape(part)) for part in re.split(r'(\*\*|\*)', pattern))
    return re.fullmatch(whole.replace('/.*', '(/.*)?'), node_name) is not None
