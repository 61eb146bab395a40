"""config/autocalib.yaml documents every option; it must not drift from config.py."""

from pathlib import Path

import pytest
import yaml

from autocalib_ros.config import NodeOptions, Options, OptionSpec, flatten, walk_options

FILE = Path(__file__).parent.parent / 'config' / 'autocalib.yaml'
OPTIONS = [*walk_options(Options()), *walk_options(NodeOptions())]


@pytest.fixture(scope='module')
def text() -> str:
    return FILE.read_text(encoding='utf-8')


@pytest.fixture(scope='module')
def values(text) -> dict:
    return flatten(yaml.safe_load(text)['/**']['ros__parameters'])


def prose(text: str) -> str:
    """Return the comments as one line of text."""
    return ' '.join(' '.join(line.strip().lstrip('#') for line in text.splitlines() if '#' in line).split())


def described(item: OptionSpec) -> str:
    """Return how the file describes an option: a sentence, and the choices if it has any."""
    doc = item.doc[0].upper() + item.doc[1:]
    return f'{doc}. One of: {", ".join(item.choices)}.' if item.choices else f'{doc}.'


def permitted(item: OptionSpec) -> str:
    """Return how the file gives the range of an option."""
    return f'At least {item.low}.' if item.high is None else f'{item.low} to {item.high}.'


def test_file_lists_exactly_the_options(values):
    assert list(values) == [item.name for item in OPTIONS]


def test_file_gives_every_default_in_its_type(values):
    found = {item.name: (type(values[item.name]), values[item.name]) for item in OPTIONS}
    assert found == {item.name: (type(item.default), item.default) for item in OPTIONS}


def test_file_describes_every_option_and_its_choices(text):
    comments = prose(text)
    assert not [item.name for item in OPTIONS if described(item) not in comments]


def test_file_gives_the_range_of_every_option(text):
    comments = prose(text)
    with_range = [item for item in OPTIONS if item.low is not None]
    assert with_range and not [item.name for item in with_range if f'{item.doc[1:]}. {permitted(item)}' not in comments]
