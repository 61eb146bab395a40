"""Messages of errors are one line that can be printed, whatever names and values they quote."""

import pickle

import pytest

from autocalib_ros.errors import AutocalibError, InputError, UsageError


@pytest.mark.parametrize('kind', [AutocalibError, InputError, UsageError])
@pytest.mark.parametrize(
    ('message', 'printed'),
    [
        ('two\nlines', r'two\nlines'),
        ('\x1b[31mred', r'\x1b[31mred'),
        ('half \ud800', r'half \ud800'),
        ('3 ± 1 ü', '3 ± 1 ü'),
    ],
)
def test_what_cannot_be_printed_is_written_as_its_code(kind, message, printed):
    assert str(kind(message)) == printed and printed.encode()
    assert str(pickle.loads(pickle.dumps(kind(message)))) == printed


def test_message_with_a_name_of_a_megabyte_keeps_its_beginning_and_its_remedy():
    text = str(InputError(f'the encoding {"x" * 10**6} is none: set another'))
    assert text.startswith('the encoding x') and text.endswith(' is none: set another') and len(text) < 3100
