"""Terminal layout: colours, aligned tables, truncated lines."""

from __future__ import annotations

import io
import re
from dataclasses import replace

import pytest

from autocalib_ros.offline.terminal.style import align_columns, coloured, state_colour, truncate, wants_colour
from autocalib_ros.offline.terminal.summary import summary_lines
from autocalib_ros.results.statements import Statement


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ('environment', 'on_terminal', 'elsewhere'),
    [
        ({}, True, False),
        ({'NO_COLOR': '1'}, False, False),
        ({'NO_COLOR': '0'}, False, False),
        ({'NO_COLOR': ''}, True, False),
        ({'TERM': 'dumb'}, False, False),
        ({'FORCE_COLOR': '1'}, True, True),
        ({'FORCE_COLOR': '1', 'NO_COLOR': '1'}, False, False),
    ],
)
def test_colours_are_for_terminals_that_want_them(environment, on_terminal, elsewhere, monkeypatch):
    for name in ('NO_COLOR', 'FORCE_COLOR'):
        monkeypatch.delenv(name, raising=False)
    for name, value in {'TERM': 'xterm', **environment}.items():
        monkeypatch.setenv(name, value)
    assert (wants_colour(Terminal()), wants_colour(io.StringIO())) == (on_terminal, elsewhere)


def test_a_painted_text_ends_its_colour(monkeypatch):
    monkeypatch.setenv('TERM', 'xterm')
    monkeypatch.delenv('NO_COLOR', raising=False)
    assert coloured('so', 'green', Terminal()) == '\033[32mso\033[0m'
    assert coloured('so', 'green', io.StringIO()) == 'so'


def test_green_is_what_was_asked_for_yellow_a_part_of_it_red_nothing(full, lens_only, refused):
    assumed = replace(full.result, grade='assumed')
    assert [state_colour(result) for result in (full.result, assumed, lens_only.result, refused.result)] == [
        'green',
        'yellow',
        'yellow',
        'red',
    ]


@pytest.mark.parametrize(('columns', 'shown'), [(20, 'three tracks, of 40'), (13, 'three tracks…'), (1, '…'), (-3, '')])
def test_a_text_is_cut_to_the_columns_there_are(columns, shown):
    assert truncate('three tracks,\n of 40', columns) == shown


def test_columns_stand_below_each_other():
    assert align_columns([('a', 'one', '1'), ('long', 'b', '2')]) == ['a     one  1', 'long  b    2']


def test_the_summary_has_the_numbers_with_their_sigmas(full):
    lines = summary_lines(full.result, full.accepted_at_s)
    assert re.fullmatch(r' +value +1 sigma', lines[0])
    assert re.match(r'  focal length +140.00 px +± 1.50$', lines[1])
    assert any(re.match(r'  tilt +40.00 degrees +± 0.20$', line) for line in lines)
    assert '  assumed:    the two roads are perpendicular' in lines
    sigma_column = lines[0].index('1 sigma')
    assert {line.index('±') for line in lines if '±' in line} == {sigma_column}


def test_long_words_of_the_summary_are_indented_on_the_next_line(full):
    result = replace(full.result, checks=(Statement('unknown', 'words ' * 30),))
    lines = summary_lines(result, columns=80)
    begin = next(index for index, line in enumerate(lines) if line.startswith('  checked:'))
    assert max(map(len, lines)) <= 80
    assert lines[begin + 1].startswith(' ' * 14 + 'words')


def test_a_refusal_says_what_was_seen_and_what_helps(refused):
    lines = summary_lines(refused.result)
    assert any('tracks of' in line for line in lines)
    assert lines[-1] == '  what helps: Record at a busier time.'
