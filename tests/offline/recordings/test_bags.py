"""ROS recordings: formats, topics, stamps, damaged files."""

from __future__ import annotations

import shutil
import sqlite3
import struct

import numpy as np
import pytest
import yaml

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.offline.recordings.open import open_source
from autocalib_ros.offline.simulate.stamp_faults import STAMP_FAULTS
from autocalib_ros.perception.header_stamps import HeaderStamps

SECOND = 1_000_000_000
KINDS = [
    (False, 'NONE'),
    (False, 'MESSAGE'),
    (False, 'FILE'),
    (True, 'NONE'),
    (True, 'MESSAGE'),
    (True, 'FILE'),
    (True, 'STORAGE'),
]


def brightness(source):
    return [int(frame.image.mean()) for frame in source.frames()]


@pytest.mark.parametrize(('mcap', 'compression'), KINDS)
def test_every_kind_of_rosbag2_gives_its_images(tmp_path, write_bag, images, mcap, compression):
    path = write_bag(tmp_path / 'bag', images(4), mcap=mcap, compression=compression)
    source = open_source(path)
    assert (source.topic, source.camera_frame, source.total) == ('/cam1/image_raw', 'cam1_optical', 4)
    frames = list(source.frames())
    assert [frame.stamp_ns for frame in frames] == [100 * SECOND + index * SECOND // 10 for index in range(4)]
    assert [int(frame.image[0, 0]) for frame in frames] == [5, 15, 25, 35]


def test_a_folder_may_be_named_like_a_file_of_ros1(tmp_path, write_bag, images):
    source = open_source(write_bag(tmp_path / 'north.bag', images(3)))
    assert len(list(source.frames())) == len(list(source.stored())) == 3


@pytest.mark.parametrize(('mcap', 'compression'), [kind for kind in KINDS if kind[1] != 'FILE'])
def test_a_lone_file_without_metadata_is_read(tmp_path, write_bag, images, mcap, compression):
    bag = write_bag(tmp_path / 'bag', images(4), mcap=mcap, compression=compression)
    suffix = '.mcap' if mcap else '.db3'
    lone = shutil.copy(bag / f'bag{suffix}', tmp_path / f'lone{suffix}')
    assert brightness(open_source(lone)) == [5, 15, 25, 35]


def test_a_folder_without_metadata_gives_all_its_parts_in_order(tmp_path, write_bag, images):
    folder = tmp_path / 'killed'
    folder.mkdir()
    for name, begin_s in (('b', 100), ('a', 200)):
        part = write_bag(tmp_path / name, images(3, begin_ns=begin_s * SECOND), mcap=True)
        shutil.copy(part / f'{name}.mcap', folder)
    seconds = [frame.stamp_ns // SECOND for frame in open_source(folder).frames()]
    assert seconds == [100] * 3 + [200] * 3


def test_an_old_sqlite_bag_without_message_definitions_is_read(tmp_path, write_bag, images):
    bag = write_bag(tmp_path / 'bag', images(3))
    old = tmp_path / 'old.db3'
    with sqlite3.connect(bag / 'bag.db3') as new:
        rows = new.execute('SELECT topic_id, timestamp, data FROM messages').fetchall()
    new.close()
    with sqlite3.connect(old) as database:
        database.execute('CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)')
        database.execute('CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INT, timestamp INT, data BLOB)')
        database.execute("INSERT INTO topics VALUES (1, '/image', 'sensor_msgs/msg/Image', 'cdr')")
        database.executemany('INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)', rows)
    database.close()
    assert brightness(open_source(old)) == [5, 15, 25]


def test_a_ros1_bag_is_read(tmp_path, write_bag1, images, ros1_image):
    source = open_source(write_bag1(tmp_path / 'one.bag', images(3, make_one=ros1_image)))
    assert brightness(source) == [5, 15, 25]
    assert source.camera_frame == 'cam1_optical'


def test_compressed_images_are_read(tmp_path, write_bag, images, jpeg):
    source = open_source(write_bag(tmp_path / 'bag', images(3, topic='/cam1/image_raw/compressed', make_one=jpeg)))
    # JPEG keeps a flat grey within two levels
    assert np.allclose(brightness(source), [5, 15, 25], atol=2)


def test_two_image_topics_have_to_be_chosen_from(tmp_path, write_bag, images):
    path = write_bag(tmp_path / 'bag', images(2, '/a') + images(3, '/b'))
    with pytest.raises(UsageError, match=r'2 image topics.*--topic.*/a \(sensor_msgs/msg/Image, 2 messages\), /b'):
        open_source(path)
    assert open_source(path, topic='b').total == 3


def test_an_image_topic_without_messages_is_no_choice(tmp_path, write_bag, images):
    path = write_bag(tmp_path / 'bag', images(2, '/a'), topics=(('/b', 'sensor_msgs/msg/Image'),))
    assert open_source(path).topic == '/a'


@pytest.mark.parametrize(
    ('topic', 'message'),
    [
        ('/nowhere', 'has no topic /nowhere; its image topics: /cam1/image_raw'),
        ('/heads', 'has no images but /heads .std_msgs/msg/Header'),
    ],
)
def test_a_wrong_topic_is_answered_with_the_right_ones(tmp_path, write_bag, images, a_header, topic, message):
    path = write_bag(tmp_path / 'bag', [*images(2), ('/heads', 100 * SECOND, a_header)])
    with pytest.raises(UsageError, match=message):
        open_source(path, topic=topic)


def test_a_bag_without_images_says_what_it_holds(tmp_path, write_bag, a_header):
    path = write_bag(tmp_path / 'bag', [('/heads', SECOND, a_header)])
    with pytest.raises(InputError, match='has no images; its topics: /heads'):
        open_source(path)


@pytest.mark.parametrize('mcap', [False, True])
def test_an_empty_bag_is_said_to_be_empty(tmp_path, write_bag, mcap):
    path = write_bag(tmp_path / 'bag', [], mcap=mcap, topics=(('/a', 'sensor_msgs/msg/Image'),))
    with pytest.raises(InputError, match='empty recording'):
        open_source(path)


@pytest.mark.parametrize(
    ('stamps', 'what'), [(lambda _: 0, 'no time stamp'), (lambda _: 7 * SECOND, 'the same time stamp')]
)
def test_useless_header_stamps_give_way_to_the_time_of_recording(
    tmp_path, write_bag, images, a_header_at, caplog, stamps, what
):
    messages = images(4)
    for _, recorded_ns, message in messages:
        message.header = a_header_at(stamps(recorded_ns))
    source = open_source(write_bag(tmp_path / 'bag', messages))
    assert [frame.stamp_ns for frame in source.frames()] == [recorded_ns for _, recorded_ns, _ in messages]
    assert len(caplog.records) == 1
    assert what in caplog.text


def test_images_come_in_the_order_of_recording_with_their_stamps(tmp_path, write_bag, images, a_header_at, caplog):
    messages, tenths = images(6), [0, 1, 3, 2, 4, -500]
    for (_, _, message), tenth in zip(messages, tenths, strict=True):
        message.header = a_header_at(100 * SECOND + tenth * SECOND // 10)
    frames = open_source(write_bag(tmp_path / 'bag', messages)).frames()
    assert [(frame.stamp_ns - 100 * SECOND) * 10 // SECOND for frame in frames] == tenths  # the frame clock judges them
    assert not caplog.records


def test_stamps_of_whole_seconds_lose_no_image(tmp_path, write_bag, images, a_header_at, caplog):
    messages = images(60)
    for _, recorded_ns, message in messages:
        message.header = a_header_at((recorded_ns + 8 * SECOND // 10) // SECOND * SECOND)
    frames = list(open_source(write_bag(tmp_path / 'bag', messages)).frames())
    assert len(frames) == 60
    assert np.diff([frame.stamp_ns for frame in frames[12:]]) == pytest.approx(np.diff([m[1] for m in messages[12:]]))
    assert len(caplog.records) == 1


@pytest.mark.parametrize('fault', ['even', 'seconds', 'stopped', 'zeros', 'wrapped_in_seconds', 'one_ahead_10_min'])
def test_a_replay_chooses_the_stamps_of_the_live_node(tmp_path, write_bag, images, a_header_at, fault):
    messages = images(90)
    recorded_ns = np.array([recorded for _, recorded, _ in messages])
    if fault == 'zeros':
        given = np.where(np.arange(90) % 20 == 10, 0, recorded_ns - SECOND // 30)
    else:
        given = STAMP_FAULTS[fault](recorded_ns - SECOND // 30, np.random.default_rng(0)).stamps_ns
    live, expected = HeaderStamps(lambda _: None), []
    for (_, received_ns, message), stamp_ns in zip(messages, given.tolist(), strict=True):
        message.header = a_header_at(stamp_ns)
        if fault == 'wrapped_in_seconds':
            true_ns = received_ns - SECOND // 30
            message.header.stamp.sec, message.header.stamp.nanosec = true_ns // SECOND, true_ns % 2**32
        expected.append(live.choose(message.header.stamp.sec, message.header.stamp.nanosec, received_ns))
    frames = open_source(write_bag(tmp_path / 'bag', messages)).frames()
    assert [frame.stamp_ns for frame in frames][1:] == expected[1:]  # a recording knows the second at the first


def test_simulated_time_begins_at_zero(tmp_path, write_bag, images, a_header_at, caplog):
    messages = images(6)
    for index, (_, _, message) in enumerate(messages):
        message.header = a_header_at(index * SECOND // 30)
    frames = open_source(write_bag(tmp_path / 'bag', messages)).frames()
    assert [frame.stamp_ns for frame in frames] == [index * SECOND // 30 for index in range(6)]
    assert not caplog.records


def test_an_image_that_cannot_be_decoded_is_skipped_and_counted(tmp_path, write_bag, images, caplog):
    messages = images(5)
    messages[2][2].encoding = 'unheard_of'
    messages[3][2].data = messages[3][2].data[:10]
    assert brightness(open_source(write_bag(tmp_path / 'bag', messages))) == [5, 15, 45]
    assert [record.message for record in caplog.records] == [
        "2 of 5 images could not be decoded and were skipped; the first: image encoding 'unheard_of' is not supported"
    ]


def test_only_images_that_cannot_be_decoded_are_an_error(tmp_path, write_bag, images):
    path = write_bag(tmp_path / 'bag', images(3, encoding='32FC2'))
    with pytest.raises(InputError, match=r"none of the 3 images on /cam1/image_raw.*encoding '32FC2' is not supported"):
        list(open_source(path).frames())


def test_the_window_counts_from_the_first_image(tmp_path, write_bag, images):
    source = open_source(write_bag(tmp_path / 'bag', images(8)), start_s=0.2, duration_s=0.3)
    assert brightness(source) == [25, 35, 45]
    assert source.total == 3
    assert source.duration_s == pytest.approx(0.3)


def test_a_window_behind_the_end_is_an_error(tmp_path, write_bag, images):
    source = open_source(write_bag(tmp_path / 'bag', images(8)), start_s=60)
    with pytest.raises(InputError, match='no image 60 s after the start'):
        list(source.frames())


def test_a_source_can_be_gone_through_twice(tmp_path, write_bag, images):
    source = open_source(write_bag(tmp_path / 'bag', images(3)))
    assert brightness(source) == brightness(source)


def noisy(images, count):
    """Return images of noise, which do not compress, so that truncation hits them."""
    messages = images(count)
    random = np.random.default_rng(1)
    for _, _, message in messages:
        message.data = random.integers(0, 255, message.data.shape, np.uint8)
    return messages


def test_a_torn_mcap_without_its_footer_gives_all_whole_images(tmp_path, write_bag, images, caplog):
    bag = write_bag(tmp_path / 'bag', noisy(images, 6), mcap=True)
    whole = (bag / 'bag.mcap').read_bytes()
    torn = tmp_path / 'torn.mcap'
    torn.write_bytes(whole[:-20])
    assert len(brightness(open_source(torn))) == 6
    assert len(caplog.records) == 1
    assert 'ended early, its recorder did not close it' in caplog.text


def test_a_folder_with_a_torn_mcap_gives_all_whole_images(tmp_path, write_bag, images, caplog):
    bag = write_bag(tmp_path / 'bag', noisy(images, 6), mcap=True)
    (bag / 'bag.mcap').write_bytes((bag / 'bag.mcap').read_bytes()[:-20])
    assert len(brightness(open_source(bag))) == 6
    assert 'ended early' in caplog.text


def test_an_empty_metadata_file_is_as_good_as_none(tmp_path, write_bag, images):
    bag = write_bag(tmp_path / 'bag', images(3))
    (bag / 'metadata.yaml').write_text('')
    assert brightness(open_source(bag)) == [5, 15, 25]


def test_a_torn_mcap_without_a_whole_image_is_an_error(tmp_path, write_bag, images, caplog):
    bag = write_bag(tmp_path / 'bag', noisy(images, 6), mcap=True)
    torn = tmp_path / 'torn.mcap'
    torn.write_bytes((bag / 'bag.mcap').read_bytes()[:2000])
    with pytest.raises(InputError, match='empty recording'):
        open_source(torn)
    assert not caplog.records


@pytest.mark.parametrize('name', ['one.bag', 'one.bag.active'])
def test_a_ros1_bag_whose_recorder_was_killed_gives_its_images(tmp_path, write_bag1, images, ros1_image, name):
    whole = write_bag1(tmp_path / 'whole.bag', images(6, make_one=ros1_image)).read_bytes()
    begin = whole.index(b'index_pos=') + len(b'index_pos=')
    (tmp_path / name).write_bytes(whole[:begin] + bytes(8) + whole[begin + 8 : -300])
    assert brightness(open_source(tmp_path / name)) == [5, 15, 25, 35, 45, 55]


@pytest.mark.parametrize('fraction', [0.3, 0.6, 0.9])
def test_a_torn_sqlite_file_gives_images_or_one_line(tmp_path, write_bag, images, fraction):
    bag = write_bag(tmp_path / 'bag', noisy(images, 60))
    whole = (bag / 'bag.db3').read_bytes()
    torn = tmp_path / 'torn.db3'
    torn.write_bytes(whole[: int(fraction * len(whole))])
    try:
        assert brightness(open_source(torn))
    except InputError as error:
        assert '\n' not in str(error)


def test_a_database_that_computes_its_messages_is_refused(tmp_path, write_bag, images):
    """A row of 20 bytes would give 900 MB."""
    whole = write_bag(tmp_path / 'bag', images(1)) / 'bag.db3'
    database = sqlite3.connect(whole)
    with database:
        database.execute('ALTER TABLE messages RENAME TO stored')
        database.execute(
            'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INT, timestamp INT, data AS (zeroblob(900000000)))'
        )
        database.execute('INSERT INTO messages(topic_id, timestamp) SELECT topic_id, timestamp FROM stored')
    database.close()
    with pytest.raises(InputError, match='has columns that are computed'):
        open_source(whole)


@pytest.mark.parametrize('name', ['text.mcap', 'text.db3', 'text.bag'])
def test_a_text_file_named_as_a_recording_is_one_clear_line(tmp_path, name):
    path = tmp_path / name
    path.write_text('this is no recording, only a few words that somebody saved under the wrong name\n' * 3)
    with pytest.raises(InputError, match=r'cannot read .*text') as raised:
        open_source(path)
    assert '\n' not in str(raised.value)


@pytest.mark.parametrize(
    ('yaml', 'message'),
    [('{', 'its metadata.yaml lists none'), ('rosbag2_bagfile_information: {relative_file_paths: [a.mcap]}', 'a.mcap')],
)
def test_broken_metadata_is_one_clear_line(tmp_path, yaml, message):
    (tmp_path / 'metadata.yaml').write_text(yaml)
    with pytest.raises(InputError, match=message) as raised:
        open_source(tmp_path)
    assert '\n' not in str(raised.value)


def test_a_folder_that_is_no_recording_is_said_to_be_none(tmp_path):
    with pytest.raises(InputError, match='is not a recording'):
        open_source(tmp_path)


def test_a_missing_and_an_empty_file_are_told_apart(tmp_path):
    with pytest.raises(InputError, match='does not exist'):
        open_source(tmp_path / 'nowhere.mcap')
    (tmp_path / 'nothing.mcap').touch()
    with pytest.raises(InputError, match=r'is empty \(0 bytes\)'):
        open_source(tmp_path / 'nothing.mcap')


def to_wal(database, folder, checkpointed):
    """Write a database as a killed recorder leaves it: the rest of its messages in the write-ahead log."""
    folder.mkdir()
    open_copy = folder.parent / 'open.db3'
    source, copy = sqlite3.connect(database), sqlite3.connect(open_copy)
    copy.execute('PRAGMA journal_mode=WAL')
    copy.execute('PRAGMA wal_autocheckpoint=0')
    for (statement,) in source.execute('SELECT sql FROM sqlite_master WHERE sql IS NOT NULL').fetchall():
        copy.execute(statement)
    for table in ('schema', 'metadata', 'topics', 'message_definitions'):
        for row in source.execute(f'SELECT * FROM {table}').fetchall():
            copy.execute(f'INSERT INTO {table} VALUES ({",".join("?" * len(row))})', row)
    rows = source.execute('SELECT * FROM messages').fetchall()
    for part in (rows[:checkpointed], rows[checkpointed:]):
        copy.executemany('INSERT INTO messages VALUES (?, ?, ?, ?)', part)
        copy.commit()
        if part is rows[:checkpointed] or len(part) == checkpointed:
            copy.execute('PRAGMA wal_checkpoint(TRUNCATE)')
    for path in folder.parent.glob('open.db3*'):
        shutil.copy(path, folder)
    source.close()
    copy.close()


@pytest.mark.parametrize('checkpointed', [0, 3])
def test_messages_in_the_log_of_a_killed_recorder_are_read(tmp_path, write_bag, images, caplog, checkpointed):
    bag = write_bag(tmp_path / 'bag', images(8))
    to_wal(bag / 'bag.db3', tmp_path / 'killed', checkpointed)
    before = {path.name: path.read_bytes() for path in (tmp_path / 'killed').iterdir()}
    assert brightness(open_source(tmp_path / 'killed')) == list(range(5, 85, 10))
    assert 'was not closed by its recorder: the messages in its log are read too' in caplog.text
    assert {path.name: path.read_bytes() for path in (tmp_path / 'killed').iterdir()} == before


def edit_metadata(bag, edit):
    document = yaml.safe_load((bag / 'metadata.yaml').read_text())
    edit(document['rosbag2_bagfile_information'])
    (bag / 'metadata.yaml').write_text(yaml.safe_dump(document))


def other_qos(info):
    zero = {'sec': 0, 'nsec': 0}
    info['topics_with_message_count'][0]['topic_metadata']['offered_qos_profiles'] = [
        {'history': 'keep_last', 'depth': 10, 'reliability': 'reliable', 'durability': 'volatile', 'deadline': zero}
        | {'lifespan': zero, 'liveliness': 'automatic', 'liveliness_lease_duration': zero}
        | {'avoid_ros_namespace_conventions': False}
    ]


def counts_of_zero(info):
    info['message_count'] = 0
    info['topics_with_message_count'][0]['message_count'] = 0


@pytest.mark.parametrize('mcap', [False, True])
@pytest.mark.parametrize(
    'edit',
    [
        other_qos,
        counts_of_zero,
        lambda info: info.update(topics_with_message_count=[]),
        lambda info: info.update(storage_identifier=''),
        lambda info: info.update(version=99),
        lambda info: info['topics_with_message_count'][0]['topic_metadata'].update(serialization_format='json'),
        lambda info: info.update(starting_time={'nanoseconds_since_epoch': 0}, duration={'nanoseconds': 0}),
    ],
)
def test_metadata_that_says_otherwise_loses_no_image(tmp_path, write_bag, images, caplog, edit, mcap):
    bag = write_bag(tmp_path / 'bag', images(4), mcap=mcap)
    edit_metadata(bag, edit)
    source = open_source(bag)
    assert (source.total, brightness(source)) == (4, [5, 15, 25, 35])
    assert not caplog.records


@pytest.mark.parametrize('mcap', [False, True])
@pytest.mark.parametrize('with_metadata', [False, True])
def test_parts_without_a_byte_and_missing_ones_are_left_out_and_told(
    tmp_path, write_bag, images, caplog, mcap, with_metadata
):
    suffix, folder = '.mcap' if mcap else '.db3', tmp_path / 'split'
    folder.mkdir()
    for part in range(2):
        bag = write_bag(tmp_path / f'p{part}', images(3, begin_ns=(100 + part) * SECOND), mcap=mcap)
        shutil.copy(bag / f'p{part}{suffix}', folder / f'split_{part}{suffix}')
    (folder / f'split_2{suffix}').touch()
    if with_metadata:
        shutil.copy(bag / 'metadata.yaml', folder)
        names = [f'split_{part}{suffix}' for part in range(4)]
        edit_metadata(folder, lambda info: info.update(relative_file_paths=names))
    assert len(brightness(open_source(folder))) == 6
    assert f'files without any byte are left out: split_2{suffix}' in caplog.text
    assert (f'files of the recording are missing: split_3{suffix}' in caplog.text) == with_metadata


def test_a_part_that_is_no_recording_is_left_out_and_told(tmp_path, write_bag, images, caplog):
    bag = write_bag(tmp_path / 'bag', images(3), mcap=True)
    (bag / 'bag_1.mcap').write_text('only words')
    assert brightness(open_source(bag)) == [5, 15, 25]
    assert [record.message for record in caplog.records] == [
        f'left out: cannot read {bag / "bag_1.mcap"}: File magic is invalid'
    ]


@pytest.mark.parametrize('mcap', [False, True])
def test_files_packed_as_a_whole_are_read_without_metadata(tmp_path, write_bag, images, mcap):
    bag = write_bag(tmp_path / 'bag', images(4), mcap=mcap, compression='FILE')
    (bag / 'metadata.yaml').unlink()
    (packed,) = bag.iterdir()
    assert brightness(open_source(packed)) == [5, 15, 25, 35]


def record(opcode, content):
    return struct.pack('<BQ', opcode, len(content)) + content


def text(value):
    return struct.pack('<I', len(value)) + value.encode()


class Mcap:
    """An MCAP file without index, record by record."""

    def __init__(self, profile='ros2', kind='sensor_msgs/msg/Image', encoding='cdr'):
        self.head = b'\x89MCAP0\r\n' + record(1, text(profile) + text('x'))
        self.channels = record(3, struct.pack('<H', 1) + text(kind) + text('ros2msg') + text(''))
        self.channels += record(4, struct.pack('<HH', 1, 1) + text('/cam1/image_raw') + text(encoding) + text(''))

    @staticmethod
    def message(at, data, channel=1):
        return record(5, struct.pack('<HIQQ', channel, 0, at, at) + data)

    @staticmethod
    def chunk(times, records):
        return record(
            6,
            struct.pack('<QQQI', min(times), max(times), len(records), 0)
            + text('')
            + struct.pack('<Q', len(records))
            + records,
        )

    def write(self, path, body):
        path.write_bytes(self.head + body + record(15, bytes(4)) + record(2, bytes(20)) + b'\x89MCAP0\r\n')
        return path


def serialised(jazzy, messages):
    return [(at, bytes(jazzy.serialize_cdr(message, message.__msgtype__))) for _, at, message in messages]


def test_a_json_channel_beside_the_images_is_no_hindrance(tmp_path, images, jazzy, caplog):
    mcap = Mcap()
    body = mcap.channels + record(3, struct.pack('<H', 2) + text('foxglove.Log') + text('jsonschema') + text('{}'))
    body += record(4, struct.pack('<HH', 2, 2) + text('/log') + text('json') + text(''))
    body += b''.join(mcap.message(at, data) for at, data in serialised(jazzy, images(4)))
    path = mcap.write(tmp_path / 'json.mcap', body + mcap.message(200 * SECOND, b'{"a": 1}', 2))
    assert brightness(open_source(path)) == [5, 15, 25, 35]
    assert not caplog.records
    with pytest.raises(UsageError, match=r'/log has no images but /log .foxglove\.Log in json'):
        open_source(path, topic='/log')


@pytest.mark.parametrize('chunked', [False, True])
def test_a_merged_file_out_of_order_is_sorted(tmp_path, images, jazzy, caplog, chunked):
    mcap = Mcap()
    messages = serialised(jazzy, images(10))
    messages = messages[5:] + messages[:5]
    if chunked:
        groups = [messages[:5], messages[5:]]
        body = b''.join(
            mcap.chunk([at for at, _ in group], mcap.channels + b''.join(mcap.message(*one) for one in group))
            for group in groups
        )
    else:
        body = mcap.channels + b''.join(mcap.message(at, data) for at, data in messages)
    assert brightness(open_source(mcap.write(tmp_path / 'merged.mcap', body))) == list(range(5, 105, 10))
    assert not caplog.records


def test_a_damaged_chunk_is_left_out_and_told(tmp_path, images, jazzy, caplog):
    mcap = Mcap()
    chunks = [mcap.chunk([at], mcap.channels + mcap.message(at, data)) for at, data in serialised(jazzy, images(3))]
    damaged = chunks[1].replace(struct.pack('<I', 0) + struct.pack('<Q', len(chunks[1]) - 49), text('lz4') + bytes(5))
    assert damaged != chunks[1]
    path = mcap.write(tmp_path / 'damaged.mcap', chunks[0] + damaged + chunks[2])
    assert brightness(open_source(path)) == [5, 25]
    assert '1 damaged chunks are left out' in caplog.text


def test_messages_of_ros1_in_mcap_are_read(tmp_path, write_bag1, images, ros1_image, noetic):
    mcap = Mcap('ros1', 'sensor_msgs/Image', 'ros1')
    messages = images(3, make_one=ros1_image)
    body = mcap.channels + b''.join(
        mcap.message(at, bytes(noetic.serialize_ros1(message, message.__msgtype__))) for _, at, message in messages
    )
    assert brightness(open_source(mcap.write(tmp_path / 'one.mcap', body))) == [5, 15, 25]
