"""Archives of arrays are looked at before they are unpacked."""

import zipfile

import numpy as np
import pytest
from hostile_files import npy_of, zip_of

from autocalib_ros.errors import InputError
from autocalib_ros.util.packed_arrays import packed_arrays

LIMIT = 10_000_000


def test_arrays_are_read(tmp_path):
    np.savez_compressed(tmp_path / 'a.npz', a=np.arange(5), b='text', c=np.zeros((0, 3)))
    with packed_arrays(tmp_path / 'a.npz', LIMIT) as arrays:
        assert arrays['a'].tolist() == [0, 1, 2, 3, 4] and str(arrays['b']) == 'text' and arrays['c'].shape == (0, 3)


@pytest.mark.parametrize(
    'members',
    [
        {'a.npy': npy_of((LIMIT // 8,), bytes(LIMIT))},
        {'a.npy': npy_of((10**12,))},
        {'a.npy': npy_of((2**40, 2**40))},
        {f'{name}.npy': npy_of((LIMIT // 16,)) for name in 'abc'},
    ],
    ids=['zeros', 'header alone', 'product', 'several'],
)
def test_arrays_that_fill_the_memory_are_refused(tmp_path, members):
    (tmp_path / 'bomb.npz').write_bytes(zip_of(members))
    with (
        pytest.raises(InputError, match=r'bomb.npz unpacks to \d+ MB; at most 10 MB are read'),
        packed_arrays(tmp_path / 'bomb.npz', LIMIT),
    ):
        pass


@pytest.mark.parametrize('content', [b'', b'PK', zip_of({'a.npy': b'no array'}), zip_of({'a.npy': npy_of((-5,))})])
def test_damaged_archives_raise_what_numpy_raises(tmp_path, content):
    (tmp_path / 'a.npz').write_bytes(content)
    with pytest.raises((ValueError, zipfile.BadZipFile)), packed_arrays(tmp_path / 'a.npz', LIMIT):
        pass
