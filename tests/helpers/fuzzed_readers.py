"""Every reader of files, with whole files to be damaged: what is not read has to be refused in one line of ours."""

from __future__ import annotations

import io
import json
import re
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from random import Random
from types import SimpleNamespace

import cv2
import numpy as np
from PIL import Image
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from autocalib_ros.config import BufferOptions, Options
from autocalib_ros.errors import AutocalibError, UsageError
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera_info_yaml import camera_info_yaml, read_camera_info, read_exact_lens
from autocalib_ros.offline.ground_truth import read_truth, true_camera
from autocalib_ros.offline.parameter_file import camera_info_file, override_options, parse_assignments, read_params_file
from autocalib_ros.offline.recordings.image_files import EXIF_IFD, EXIF_ORIENTATION, EXIF_SUBSECOND, EXIF_TIME
from autocalib_ros.offline.recordings.open import open_source
from autocalib_ros.offline.recordings.unpacking import zstd_module
from autocalib_ros.offline.track_files import evidence_from_file
from autocalib_ros.perception.detector.detector import _names
from autocalib_ros.perception.image_file import read_image
from autocalib_ros.perception.images import ImageDecoder
from autocalib_ros.perception.view_file import read_views, write_views
from autocalib_ros.perception.view_watch import KnownView
from autocalib_ros.results.calibration_json import calibration_json
from autocalib_ros.results.control_points import read_control_points
from autocalib_ros.results.history import append_version, describe_version, read_history, version_entry
from autocalib_ros.results.saved_camera import read_saved_camera
from autocalib_ros.results.store import Store, stored_json
from autocalib_ros.ros.cameras import read_cameras
from stored_results import calibration, stored
from synthetic_results import junction_evidence

CONFIG = Path(__file__).parents[2] / 'config'
NASTY_TEXTS = (
    *('9' * 400, '-1', '1e999', '1e-320', 'NaN', '.inf', 'null', 'true', '""', r'"\ud800"', r'"\u0000"', '[]', '{}'),
    *(
        '2024-13-45',
        '!!timestamp x',
        '&a [*a]',
        '[' * 60,
        '{a: ' * 60,
        '<<: *a',
        "'",
        '\x1b[31m',
        '\u0661',
        '1:2:3',
        '0x',
    ),
)
"""What stands in place of a value now and then."""
NASTY_NUMBERS = (b'\0' * 4, b'\xff' * 4, b'\xff\xff\xff\x7f', b'\x7f\xff\xff\xff', b'\xff' * 8, b'\xff' * 7 + b'\x7f')
"""Sizes and counts that are absurd, in either order of bytes."""
VALUE = re.compile(r'[-\w.]+')
SECOND = 10**9


@dataclass(frozen=True)
class FuzzTarget:
    """A reader, and how its files are made and damaged."""

    name: str
    """Of the file."""
    seeds: Callable[[], list[bytes]]
    read: Callable[[Path], object]
    damage: Callable[[bytes, Random], bytes]


def damaged_bytes(data: bytes, random: Random) -> bytes:
    """Return data with a few bytes changed, put in, left out, doubled or cut off."""
    result = bytearray(data)
    for _ in range(random.choice((1, 1, 1, 2, 4, 16))):
        place = random.randrange(len(result) + 1)
        kind = random.randrange(6)
        if kind == 0 and result:
            result[min(place, len(result) - 1)] = random.randrange(256)
        elif kind == 1:
            number = random.choice(NASTY_NUMBERS)
            result[place : place + len(number)] = number
        elif kind == 2:
            del result[place : place + random.choice((1, 4, 8, 100))]
        elif kind == 3:
            result[place:place] = random.randbytes(random.choice((1, 4, 8, 100)))
        elif kind == 4:
            result[place:place] = result[place : place + random.choice((8, 64, 512))]
        elif random.random() < 0.3:
            del result[place:]
    return bytes(result)


def damaged_text(data: bytes, random: Random) -> bytes:
    """Return a text in which some names or values are others; at times it is damaged as bytes are."""
    if random.random() < 0.2:
        return damaged_bytes(data, random)
    text = data.decode()
    for _ in range(random.choice((1, 1, 2, 5))):
        values = list(VALUE.finditer(text)) or [re.match('', text)]
        chosen = random.choice(values)
        other = random.choice(NASTY_TEXTS) if random.random() < 0.7 else random.choice(values)[0]
        text = text[: chosen.start()] + other + text[chosen.end() :]
    return text.encode()


def damaged_archive(data: bytes, random: Random) -> bytes:
    """Return an archive with one member damaged, left out or named otherwise; at times the archive itself."""
    if random.random() < 0.3:
        return damaged_bytes(data, random)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    chosen = random.choice(sorted(members))
    content = members.pop(chosen)
    if random.random() < 0.9:
        head = random.random() < 0.5  # names, types and shapes are in the first 128 bytes
        damaged = damaged_bytes(content[:128], random) + content[128:] if head else damaged_bytes(content, random)
        members[chosen] = damaged
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, 'w') as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return stream.getvalue()


def _written(write: Callable[[Path], object], name: str) -> bytes:
    """Return the bytes of the file of a name in the folder in which `write` wrote it."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return (Path(folder) / name).read_bytes()


def _pictures() -> list[bytes]:
    image = np.random.default_rng(1).integers(0, 255, (24, 32, 3), np.uint8)
    return [cv2.imencode(kind, image)[1].tobytes() for kind in ('.jpg', '.png', '.tiff', '.webp', '.bmp')]


def _messages(types, count: int = 3) -> Iterator[tuple[int, object]]:
    header, time = types['std_msgs/msg/Header'], types['builtin_interfaces/msg/Time']
    for index in range(count):
        numbered = {'seq': index} if 'seq' in header.__dataclass_fields__ else {}
        stamped = header(stamp=time(sec=100, nanosec=index * 10**8), frame_id='cam', **numbered)
        pixels = np.full(24 * 16, 5 + index, np.uint8)
        yield (
            100 * SECOND + index * 10**8,
            types['sensor_msgs/msg/Image'](
                header=stamped, height=16, width=24, encoding='mono8', is_bigendian=0, step=24, data=pixels
            ),
        )


def _write_rosbag2(path: Path, plugin: StoragePlugin) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    kind = 'sensor_msgs/msg/Image'
    with Writer(path.with_suffix(''), version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection('/image_raw', kind, typestore=store)
        for time_ns, message in _messages(store.types):
            writer.write(connection, time_ns, store.serialize_cdr(message, kind))
    shutil.copy(path.with_suffix('') / path.name, path)


def _packed_recording() -> bytes:
    whole = _written(partial(_write_rosbag2, plugin=StoragePlugin.MCAP), 'b.mcap')
    return zstd_module().compress(whole)


def _write_rosbag1(path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    kind = 'sensor_msgs/msg/Image'
    writer = Writer1(path)
    writer.set_compression(Writer1.CompressionFormat.LZ4)
    with writer:
        connection = writer.add_connection('/image_raw', kind, typestore=store)
        for time_ns, message in _messages(store.types):
            writer.write(connection, time_ns, store.serialize_ros1(message, kind))


def _write_video(path: Path) -> None:
    code = cv2.VideoWriter_fourcc(*('MJPG' if path.suffix == '.avi' else 'mp4v'))
    writer = cv2.VideoWriter(str(path), code, 10.0, (64, 48))
    for index in range(4):
        writer.write(np.full((48, 64, 3), 20 * index, np.uint8))
    writer.release()


def _truth() -> bytes:
    lens = {'model': 'equidistant', 'f': 300.0, 'cx': 320.0, 'cy': 180.0, 'k': [0.0] * 4}
    pose = {'R_world_from_camera': np.eye(3).tolist(), 'height': 8.0, 'position': [0.0, 0.0, 8.0]}
    return json.dumps({'width': 640, 'height': 360, 'lens': lens, 'camera': pose}).encode()


def _without_checksum() -> bytes:
    document = json.loads(stored_json(stored(calibration())))
    del document['checksum']
    return json.dumps(document).encode()


def _read_parameters(path: Path) -> None:
    camera_info_file(path)
    override_options(Options(), read_params_file(path))


def _read_assignment(path: Path) -> None:
    override_options(Options(), parse_assignments([path.read_text(errors='surrogateescape')]))


def _read_stored(path: Path) -> None:
    store = Store(path.with_name('cam.yaml'))
    kept = stored(calibration())
    store.path.write_text(camera_info_yaml(kept.info, kept.camera_name))
    found = store.load()
    found.note.encode()
    if found.stored is not None:
        stored_json(found.stored).encode()


def _read_compressed(path: Path) -> None:
    image = ImageDecoder().decode(SimpleNamespace(format='', data=path.read_bytes()))
    assert image.dtype == np.uint8 and image.ndim in (2, 3)


def _read_recording(path: Path) -> None:
    for frame in open_source(path).frames():
        assert frame.image.dtype == np.uint8


def _photograph(path: Path) -> None:
    exif = Image.Exif()
    exif[EXIF_ORIENTATION] = 1
    exif.get_ifd(EXIF_IFD).update({EXIF_TIME: '2024:05:01 12:00:00', EXIF_SUBSECOND: '25'})
    Image.fromarray(np.full((24, 32), 90, np.uint8)).save(path, exif=exif)


def _read_photographs(path: Path) -> None:
    with suppress(UsageError):  # two images of one time need a rate
        open_source([path, path])
    for frame in open_source([path, path], rate_hz=5.0).frames():
        assert frame.image.dtype == np.uint8


def _read_history(path: Path) -> None:
    for entry in read_history(path):
        describe_version(entry).encode()


def _small_evidence() -> Evidence:
    evidence = junction_evidence()
    return replace(evidence.select_tracks(np.arange(2)), frames=60)


POINTS = b'name,u_px,v_px,x_m,y_m\n1,10,20,0,0\n2,30.5,40,10,0\n3,50,60,10,5\n'
REFERENCE_POINTS = json.dumps(
    {
        str(number): {
            'x_px': number,
            'y_px': 2,
            'lon_utm': 5e5 + number,
            'lat_utm': 5e6,
            'zone_utm': 32,
            'hemisphere': 'N',
        }
        for number in range(3)
    }
).encode()
TRACKS = b'time_s,vehicle_id,track_id,x_px,y_px\n' + b''.join(b'%.1f,1,1,%d,50\n' % (0.1 * i, 3 * i) for i in range(9))
PARAMETERS = (
    b'/**:\n  ros__parameters:\n    camera_height: 8.0\n    method: joint\n    ignore_regions: "0 0 9 0 0 9"\n'
    b'    gate: {min_tracks: 40}\n    lens: {focal_px: 0.0}\n'
)
VIEWS = (KnownView(np.full((36, 64), 7, np.uint8), None),)
TARGETS = {
    'parameters': FuzzTarget('p.yaml', lambda: [PARAMETERS], _read_parameters, damaged_text),
    'assignment': FuzzTarget('p.txt', lambda: [b'camera_height=8.0', b'method:=joint'], _read_assignment, damaged_text),
    'cameras': FuzzTarget('c.yaml', lambda: [(CONFIG / 'cameras.yaml').read_bytes()], read_cameras, damaged_text),
    'camera_info': FuzzTarget(
        'i.yaml',
        lambda: [camera_info_yaml(stored(calibration()).info, 'cam').encode()],
        lambda path: (read_exact_lens(path), read_camera_info(path)),
        damaged_text,
    ),
    'calibration': FuzzTarget(
        'c.json', lambda: [calibration_json(calibration()).encode()], read_saved_camera, damaged_text
    ),
    'stored': FuzzTarget('cam.autocalib.json', lambda: [_without_checksum()], _read_stored, damaged_text),
    'history': FuzzTarget(
        'h.jsonl',
        lambda: [_written(partial(append_version, entry=version_entry(calibration(), 'solved', 1e9)), 'h.jsonl')],
        _read_history,
        damaged_text,
    ),
    'truth': FuzzTarget('t.json', lambda: [_truth()], lambda path: true_camera(read_truth(path)), damaged_text),
    'control points': FuzzTarget('p.csv', lambda: [POINTS], read_control_points, damaged_text),
    'reference points': FuzzTarget('p.otrfpts', lambda: [REFERENCE_POINTS], read_control_points, damaged_text),
    'tracks': FuzzTarget(
        't.csv',
        lambda: [TRACKS],
        lambda path: evidence_from_file(path, (320, 180), 10.0, BufferOptions()),
        damaged_text,
    ),
    'evidence': FuzzTarget(
        'e.npz', lambda: [_written(_small_evidence().save, 'e.npz')], Evidence.load, damaged_archive
    ),
    'views': FuzzTarget(
        'v.npz',
        lambda: [_written(lambda path: write_views(path, 'this', VIEWS), 'v.npz')],
        lambda path: read_views(path, 'this'),
        damaged_archive,
    ),
    'image file': FuzzTarget('i.png', _pictures, read_image, damaged_bytes),
    'compressed image': FuzzTarget('i.bin', lambda: _pictures()[:-1], _read_compressed, damaged_bytes),
    'photographs': FuzzTarget('p.jpg', lambda: [_written(_photograph, 'p.jpg')], _read_photographs, damaged_bytes),
    'mcap': FuzzTarget(
        'b.mcap',
        lambda: [_written(partial(_write_rosbag2, plugin=StoragePlugin.MCAP), 'b.mcap')],
        _read_recording,
        damaged_bytes,
    ),
    'packed mcap': FuzzTarget('b.mcap.zstd', lambda: [_packed_recording()], _read_recording, damaged_bytes),
    'sqlite': FuzzTarget(
        'b.db3',
        lambda: [_written(partial(_write_rosbag2, plugin=StoragePlugin.SQLITE3), 'b.db3')],
        _read_recording,
        damaged_bytes,
    ),
    'ROS 1': FuzzTarget('b.bag', lambda: [_written(_write_rosbag1, 'b.bag')], _read_recording, damaged_bytes),
    'avi': FuzzTarget('v.avi', lambda: [_written(_write_video, 'v.avi')], _read_recording, damaged_bytes),
    'mp4': FuzzTarget('v.mp4', lambda: [_written(_write_video, 'v.mp4')], _read_recording, damaged_bytes),
    'model': FuzzTarget(
        'names.txt',
        lambda: [str({0: 'person', 2: 'car'}).encode(), b"['person', 'car']"],
        lambda path: _names({'names': path.read_bytes().decode(errors='replace')}),
        damaged_text,
    ),
}
"""By name; each reads whole files without an error."""


@cache
def seeds_of(target: str) -> list[bytes]:
    """Return the whole files of a reader."""
    return TARGETS[target].seeds()


def fuzz(target: str, numbers: range, folder: Path) -> int:
    """Give a reader one damaged file for each number; return how many were refused.

    The file stays in `folder` if the reader raises anything but an error of ours in one printable line.
    """
    told, what = 0, TARGETS[target]
    for number in numbers:
        random = Random(f'{target} {number}')  # each file depends on its number alone
        path = folder / what.name
        path.write_bytes(what.damage(random.choice(seeds_of(target)), random))
        try:
            what.read(path)
        except AutocalibError as error:
            told += 1
            text = str(error)
            if not text or '\n' in text:
                raise AssertionError(f'{target} {number}: {text!r} is no line') from error
            text.encode()
        except Exception as error:
            error.add_note(f'{target}, file number {number}, {path}') if hasattr(error, 'add_note') else None
            raise
    return told
