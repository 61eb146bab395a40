"""Chunks and messages of recordings are unpacked up to a size."""

import bz2
from pathlib import Path

import lz4.frame
import pytest
from rosbags.rosbag1 import reader as rosbag1_reader
from rosbags.rosbag2 import storage_mcap

from autocalib_ros.errors import InputError
from autocalib_ros.offline.recordings import bag_parts, unpacking
from autocalib_ros.offline.recordings.unpacking import unpack, unpack_file, zstd_module

PACK = {'lz4': lz4.frame.compress, 'bz2': bz2.compress, 'zstd': lambda data: zstd_module().compress(data)}
CONTENT = b'vehicle' * 1000


@pytest.mark.parametrize('compression', PACK)
def test_frames_one_after_another_are_unpacked(compression):
    packed = PACK[compression](CONTENT)
    assert unpack(compression, packed) == CONTENT
    assert unpack(compression, memoryview(packed + packed), 2 * len(CONTENT)) == 2 * CONTENT


@pytest.mark.parametrize('compression', PACK)
def test_more_than_the_limit_is_refused(compression):
    with pytest.raises(InputError, match='unpacks to more than 6999 bytes'):
        unpack(compression, PACK[compression](CONTENT), 6999)
    with pytest.raises(InputError, match='more than 1000000 bytes'):
        unpack(compression, PACK[compression](bytes(20_000_000)), 1_000_000)


@pytest.mark.parametrize('compression', PACK)
def test_cut_data_are_refused(compression):
    with pytest.raises((InputError, EOFError)):
        unpack(compression, PACK[compression](CONTENT)[:-6])


def test_data_that_are_not_packed_come_back_and_other_compressions_are_named():
    assert unpack('', CONTENT) == unpack('none', CONTENT) == CONTENT
    with pytest.raises(InputError, match='compression rar is not supported'):
        unpack('rar', CONTENT)


@pytest.fixture
def packed(quick_path) -> Path:
    """Return a file of 20 MB that was packed to some hundred bytes."""
    path = quick_path / 'bag_0.mcap.zstd'
    path.write_bytes(PACK['zstd'](CONTENT + bytes(20_000_000)))
    return path


def test_file_is_unpacked_and_a_cut_one_as_far_as_it_goes(packed, quick_path):
    copy = quick_path / 'copy'
    assert unpack_file(packed, copy) == '' and copy.read_bytes() == CONTENT + bytes(20_000_000)
    packed.write_bytes(packed.read_bytes()[:-9])
    assert unpack_file(packed, copy) != ''
    assert copy.read_bytes().startswith(CONTENT)


def test_file_that_unpacks_to_absurdly_much_leaves_no_copy(packed, quick_path, monkeypatch):
    monkeypatch.setattr(unpacking, 'ALWAYS_UNPACKED_BYTES', 10_000_000)
    with pytest.raises(InputError, match='more than 1000 times its size: unpack it yourself'):
        unpack_file(packed, quick_path / 'copy')
    assert not (quick_path / 'copy').exists()


def test_copy_leaves_room_on_the_disk(packed, quick_path, monkeypatch):
    monkeypatch.setattr(unpacking, 'MIN_FREE_BYTES', 10**18)
    with pytest.raises(InputError, match=r'needs a copy .* cannot be written: No space left .* TMPDIR'):
        bag_parts.find_parts(packed, lambda: quick_path)


@pytest.mark.parametrize('compression', ['lz4', 'zstd'])
def test_the_reader_of_mcap_unpacks_no_more_than_a_chunk_states(compression):
    packed = PACK[compression](bytes(20_000_000))
    with pytest.raises(InputError, match='more than 1000 bytes'):
        storage_mcap.decompress(packed, compression, 1000, 0)
    assert storage_mcap.decompress(PACK[compression](CONTENT), compression, len(CONTENT), 0) == CONTENT


@pytest.mark.parametrize('compression', ['lz4', 'bz2'])
def test_the_reader_of_ros_1_unpacks_with_a_limit(compression):
    assert rosbag1_reader.decompressors[compression](PACK[compression](CONTENT)) == CONTENT
    assert rosbag1_reader.decompressors[compression].func is unpack
