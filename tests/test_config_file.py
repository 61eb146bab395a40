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


def test_file_lists_exactly_the_options(values):
    assert list(values) == [item.name for item in OPTIONS]


@pytest.mark.parametrize('item', OPTIONS, ids=lambda item: item.name)
def test_file_gives_the_default_in_its_type(item: OptionSpec, values):
    assert (type(values[item.name]), values[item.name]) == (type(item.default), item.default)


@pytest.mark.parametrize('item', OPTIONS, ids=lambda item: item.name)
def test_file_describes_the_option_and_its_choices(item: OptionSpec, text):
    doc = item.doc[0].upper() + item.doc[1:]
    choices = f'. One of: {", ".join(item.choices)}.' if item.choices else '.'
    assert f'{doc}{choices}' in prose(text)


@pytest.mark.parametrize('item', [item for item in OPTIONS if item.low is not None], ids=lambda item: item.name)
def test_file_gives_the_range_of_the_option(item: OptionSpec, text):
    permitted = f'At least {item.low}.' if item.high is None else f'{item.low} to {item.high}.'
    assert f'{item.doc[1:]}. {permitted}' in prose(text)
