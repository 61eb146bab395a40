"""Modes of files: the umask decides, and what shows the street is not for others."""

import os
import stat

import pytest

from autocalib_ros.errors import InputError
from autocalib_ros.util.files import (
    NOT_FOR_OTHERS,
    OWNER_ONLY,
    create_for_picture,
    remove_temporaries,
    write_atomically,
    write_bytes_atomically,
    write_picture_bytes,
)


@pytest.fixture(params=[0o000, 0o022, 0o027, 0o077])
def umask(request):
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


def mode(path):
    return stat.S_IMODE(path.stat().st_mode)


def test_the_umask_takes_from_the_mode(umask, tmp_path):
    path = tmp_path / 'f'
    for asked in (0o666, NOT_FOR_OTHERS, OWNER_ONLY):
        write_bytes_atomically(path, b'x', asked)
        assert mode(path) == asked & ~umask
    write_atomically(path, 'y')
    assert mode(path) == 0o666 & ~umask and path.read_text() == 'y'


def test_pictures_are_not_for_others_even_where_a_file_of_before_was(umask, tmp_path):
    path = tmp_path / 'p.png'
    path.write_bytes(b'before')
    path.chmod(0o644)
    write_picture_bytes(path, b'picture')
    assert mode(path) == NOT_FOR_OTHERS & ~umask and path.read_bytes() == b'picture'
    create_for_picture(path)
    assert mode(path) == NOT_FOR_OTHERS & ~umask and path.read_bytes() == b''


def test_a_failed_write_leaves_the_file_of_before_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / 'f'
    write_atomically(path, 'before')
    monkeypatch.setattr(
        'autocalib_ros.util.files.os.replace', lambda *_: (_ for _ in ()).throw(OSError(28, 'No space'))
    )
    with pytest.raises(InputError, match='No space'):
        write_atomically(path, 'after')
    assert [one.name for one in tmp_path.iterdir()] == ['f'] and path.read_text() == 'before'


def test_what_a_killed_writer_left_is_removed(tmp_path):
    path = tmp_path / 'f'
    (tmp_path / '.f~123abcd').write_bytes(b'torn')
    remove_temporaries(path)
    assert not list(tmp_path.iterdir())
