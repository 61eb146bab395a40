"""Broken headers and data: either an InputError or an image of the stated size."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from autocalib_ros.errors import InputError
from autocalib_ros.perception.images import PACKED_ENCODINGS, PLANAR_ENCODINGS, YUV422_ENCODINGS, ImageDecoder

ENCODINGS = [*PACKED_ENCODINGS, *YUV422_ENCODINGS, *PLANAR_ENCODINGS]
NUMBER_FORMATS = st.one_of(st.integers(0, 40), st.sampled_from([2**16, 2**31, 2**32 - 1]))
"""Sizes and steps as any bits of a uint32 may be."""
PIXELS = np.random.default_rng(0).integers(0, 256, 20 * 40 * 40, np.uint8)
PIXELS.flags.writeable = False
FILES = [cv2.imencode(kind, PIXELS[:1200].reshape(20, 20, 3))[1].tobytes() for kind in ('.jpg', '.png')]


@st.composite
def mutations(draw) -> SimpleNamespace:
    """Draw a whole image of any encoding, of which some fields are then changed."""
    encoding, width, height = draw(st.sampled_from(ENCODINGS)), draw(st.integers(1, 20)), draw(st.integers(1, 20))
    step = width * (PACKED_ENCODINGS[encoding][1] // 8 * 4 if encoding in PACKED_ENCODINGS else 2)
    whole = {
        'encoding': encoding,
        'width': width,
        'height': height,
        'step': step,
        'length': 3 * step * height,
        'is_bigendian': 0,
    }
    changes = {
        'encoding': st.one_of(st.sampled_from(ENCODINGS), st.text(max_size=12)),
        'width': NUMBER_FORMATS,
        'height': NUMBER_FORMATS,
        'step': NUMBER_FORMATS,
        'length': st.integers(0, len(PIXELS)),
        'is_bigendian': st.integers(0, 255),
    }
    for name in draw(st.sets(st.sampled_from(sorted(changes)), max_size=3)):
        whole[name] = draw(changes[name])
    return SimpleNamespace(**whole, data=PIXELS[: whole['length']])


@settings(max_examples=250, deadline=None, suppress_health_check=list(HealthCheck))
@given(message=mutations())
def test_any_header_gives_an_image_of_its_size_or_an_error(message):
    try:
        image = ImageDecoder().decode(message)
    except InputError as error:
        assert str(error)
        return
    assert image.dtype == np.uint8 and image.shape in (
        (message.height, message.width),
        (message.height, message.width, 3),
    )


@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    file=st.sampled_from(FILES),
    cut=st.integers(0, 3000),
    place=st.integers(0, 3000),
    byte=st.integers(0, 255),
    said=st.text(max_size=12),
)
def test_any_bytes_give_an_image_or_an_error(file, cut, place, byte, said):
    broken = bytearray(file[:cut] if cut < len(file) else file)
    if place < len(broken):
        broken[place] = byte
    try:
        image = ImageDecoder().decode(SimpleNamespace(format=said, data=bytes(broken)))
    except InputError as error:
        assert str(error)
        return
    assert image.dtype == np.uint8 and image.ndim in (2, 3)
