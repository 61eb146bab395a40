"""Chunks and messages of recordings are unpacked up to a size."""

import bz2

import lz4.frame
import pytest
from rosbags.rosbag1 import reader as rosbag1_reader
from rosbags.rosbag2 import storage_mcap

from autocalib_ros.errors import InputError
from autocalib_ros.offline.recordings import bag_parts  # noqa: F401  sets the limits of the readers
from autocalib_ros.offline.recordings.unpacking import unpack, zstd_module

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
