"""Hostile documents are answered in one line, before they cost time or memory."""

import json

import pytest
import yaml

from autocalib_ros.errors import InputError
from autocalib_ros.util.documents import parse_json, parse_yaml, printable, read_bytes, read_json, read_text, read_yaml
from autocalib_ros.util.input_limits import MAX_DEPTH, MAX_DOCUMENT_BYTES, MAX_INTEGER

LAUGHS = 'a: &a [x, x]\n' + ''.join(
    f'{chr(98 + level)}: &{chr(98 + level)} [{", ".join([f"*{chr(97 + level)}"] * 9)}]\n' for level in range(9)
)
"""A document of less than 1 kB with 10^9 values."""
HOSTILE_YAML = {
    'laughs': (LAUGHS, 'aliases written out'),
    'merged laughs': (
        'a0: &a0 {x: 1}\n' + ''.join(f'a{n}: &a{n} {{<<: [{f"*a{n - 1}, " * 9}]}}\n' for n in range(1, 10)),
        'aliases written out',
    ),
    'circle': ('a: &a {b: *a}', 'contains itself'),
    'circle in a list': ('&a [*a]', 'contains itself'),
    'brackets': ('[' * 3000, f'more than {MAX_DEPTH} levels'),
    'names in names': ('{a: ' * 3000, f'more than {MAX_DEPTH} levels'),
    'indented': ('\n'.join(' ' * level + 'a:' for level in range(200)), f'more than {MAX_DEPTH} levels'),
    'whole number of 5,000 digits': ('a: ' + '9' * 5000, 'number of 5000 characters'),
    'whole number beyond floats': ('a: ' + '9' * 90, 'whole number of 90 digits'),
    'sexagesimal number': ('a: 1' + ':01' * 200_000, 'characters'),
    'sexagesimal float': ('a: 1' + ':01' * 200_000 + '.5', 'characters'),
    'binary number': ('a: 0b' + '1' * 200_000, 'characters'),
    'tagged date': ('a: !!timestamp x', 'is not YAML'),
    'date without a month': ('a: !!timestamp 2024-13-45', 'is not YAML'),
    'object of Python': ('a: !!python/object/apply:os.system ["true"]', 'is not YAML'),
    'half a character': (r'a: "\ud800"', 'half a character'),
    'half a character in a name': (r'"\ud800": 1', 'half a character'),
    'two documents': ('a: 1\n---\nb: 2', 'is not YAML'),
    'NUL': ('a: \0', 'is not YAML'),
    'no UTF-8': (b'a: \xff\xfe\xfd', 'is not YAML'),
    'list as a name': ('? [a]\n: 1', 'is not YAML'),
}
HOSTILE_JSON = {
    'whole number of 5,000 digits': ('[' + '9' * 5000 + ']', 'number of 5000 characters'),
    'whole number beyond floats': ('[' + '9' * 90 + ']', 'whole number of 90 digits'),
    'beyond 64 bits': (f'[{MAX_INTEGER}]', 'whole number of 20 digits'),
    'float beyond floats': ('[1e999]', 'beyond every number'),
    'NaN': ('[NaN]', 'NaN is no number'),
    'half a character': (r'["\ud800"]', 'half a character'),
    'half a character in a name': (r'{"\udfff": 1}', 'half a character'),
    'brackets': ('[' * 100_000, 'is not JSON'),
    'closed brackets': ('[' * 300 + ']' * 300, f'more than {MAX_DEPTH} levels'),
    'no UTF-8': (b'["\xff"]', 'is not JSON'),
    'nothing': ('', 'is not JSON'),
}


@pytest.mark.parametrize(('content', 'expected'), HOSTILE_YAML.values(), ids=HOSTILE_YAML)
def test_hostile_yaml_is_refused_in_one_line(content, expected):
    with pytest.raises(InputError) as told:
        parse_yaml(content)
    assert expected in str(told.value) and '\n' not in str(told.value) and len(str(told.value)) < 400
    str(told.value).encode()


@pytest.mark.parametrize(('content', 'expected'), HOSTILE_JSON.values(), ids=HOSTILE_JSON)
def test_hostile_json_is_refused_in_one_line(content, expected):
    with pytest.raises(InputError) as told:
        parse_json(content)
    assert expected in str(told.value) and '\n' not in str(told.value) and len(str(told.value)) < 400
    str(told.value).encode()


def test_dates_stay_text():
    assert parse_yaml('a: 2024-13-45\nb: 2024-01-02') == {'a': '2024-13-45', 'b': '2024-01-02'}


def test_aliases_and_merged_names_are_read():
    assert parse_yaml('a: &a {b: 1}\nc: *a\nd: {<<: *a, e: -2.5e+3}') == {
        'a': {'b': 1},
        'c': {'b': 1},
        'd': {'b': 1, 'e': -2500.0},
    }


def test_the_first_of_several_documents_is_read_on_request():
    assert parse_yaml('a: 1\n---\nb: [', first=True) == {'a': 1}
    assert parse_yaml('', first=True) is None and parse_yaml('') is None


def test_whole_numbers_of_64_bits_are_read():
    largest = MAX_INTEGER - 1
    assert parse_json(f'[{largest}, -{largest}, 0.5]') == [largest, -largest, 0.5]
    assert parse_yaml(f'[{largest}, 0x10, 1:30]') == [largest, 16, 90]


def test_documents_without_malice_are_read_as_by_the_libraries():
    document = {'a': [1, -2.5, True, None, 'ü'], 'b': {'c': '', 'd': []}, '😀': 'x' * 1000}
    assert parse_json(json.dumps(document)) == document
    assert parse_yaml(yaml.safe_dump(document, allow_unicode=True)) == document


@pytest.mark.parametrize('read', [read_yaml, read_json, read_text, read_bytes])
def test_files_are_read_up_to_a_size(read, tmp_path):
    path = tmp_path / 'long'
    path.write_bytes(b' ' * (MAX_DOCUMENT_BYTES + 1))
    with pytest.raises(InputError, match=f'longer than {MAX_DOCUMENT_BYTES} bytes, so it is no thing'):
        read(path, 'thing')
    with pytest.raises(InputError, match=r'cannot read .*nowhere: No such file'):
        read(tmp_path / 'nowhere', 'thing')


def test_an_endless_file_ends_at_the_size(tmp_path):
    path = tmp_path / 'endless'
    path.symlink_to('/dev/zero')
    with pytest.raises(InputError, match='longer than'):
        read_text(path, 'thing')


def test_errors_of_files_name_the_file(tmp_path):
    path = tmp_path / 'odd'
    path.write_bytes(b'[\xff')
    for read in (read_yaml, read_json, read_text):
        with pytest.raises(InputError, match=str(path)):
            read(path, 'thing')


def test_half_characters_are_printable():
    printable('a\ud800').encode()
    assert printable('ü') == 'ü'
