"""How detectors say their boxes, and by what each kind is told: shapes, names and what a grey image gives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.errors import UsageError
from autocalib_ros.perception.detector import decoding
from autocalib_ros.perception.detector.decoding import Decode, Outputs, Size, boxes_and_classes

MOST_QUERIES = 1000
"""Detectors that choose their boxes themselves put out a few hundred; those that leave it to us have thousands."""
MASK_COLUMNS = 32
"""What a model that segments puts behind the classes."""
ANCHORS = 3
STRIDES_OF_ANCHORS = ((8, 16, 32), (8, 16, 32, 64), (16, 32))


@dataclass(frozen=True)
class Layout:
    """How to feed a kind of detector and to read it, where options do not say otherwise."""

    decode: Decode
    resize_mode: str
    own_nms: bool = False
    """It gives each object one box by itself."""
    channel_order: str = 'rgb'
    input_scale: float = 1.0
    imagenet: bool = False


LAYOUTS = {
    'yolox': Layout(decoding.yolox, 'top_left', channel_order='bgr', input_scale=255.0),
    'yolox_decoded': Layout(decoding.yolov5, 'top_left', channel_order='bgr', input_scale=255.0),
    'yolov3': Layout(decoding.yolov3, 'centred'),
    'yolov5': Layout(decoding.yolov5, 'centred'),
    'yolov7_end2end': Layout(decoding.yolov7_end2end, 'centred'),
    'yolov8': Layout(decoding.yolov8, 'centred'),
    'end_to_end': Layout(decoding.end_to_end, 'centred', own_nms=True),
    'yolo_nas': Layout(decoding.yolo_nas, 'top_left'),
    'rtdetr': Layout(decoding.rtdetr, 'stretch', own_nms=True),
    'ultralytics_rtdetr': Layout(decoding.ultralytics_rtdetr, 'stretch', own_nms=True),
    'detr': Layout(decoding.detr, 'stretch', own_nms=True, imagenet=True),
    'tf_od': Layout(decoding.tf_od, 'stretch', own_nms=True, input_scale=255.0),
    'detection_output': Layout(decoding.detection_output, 'stretch', own_nms=True, channel_order='bgr',
                               input_scale=255.0),
}


@dataclass(frozen=True)
class Seen:
    """What a model has shown of itself: in its file, and by its answer to a grey image."""

    inputs: int
    outputs: Outputs
    size: Size
    """Width and height of that image as it was fed in."""
    names: dict[int, str]
    """Classes by number, empty where it does not name them."""
    end_to_end: bool
    """It says so."""
    shapes: str
    """Its inputs and outputs in words."""


def layout_of(seen: Seen) -> str:
    """Tell the layout; UsageError, with the shapes, where it is none that is known."""
    found = _by_name(seen) or _by_dimensions(seen)
    if found:
        return found
    if all(array.ndim in (4, 5) for array in seen.outputs.values()):
        raise UsageError(f'the model puts out raw heads, which say no boxes without their anchors ({seen.shapes}): '
                         'export it with its detection layer')
    raise UsageError(f"the model's layout is unknown ({seen.shapes}): set 'detector.layout', or export it as one of "
                     f'{", ".join(LAYOUTS)}')


def _by_name(seen: Seen) -> str | None:
    names = set(seen.outputs)
    if {'detection_boxes', 'detection_scores', 'detection_classes'} <= names:
        return 'tf_od'
    if seen.inputs == 2 and {'labels', 'boxes', 'scores'} <= names:
        return 'rtdetr'
    whole = [array for array in seen.outputs.values() if array.dtype.kind in 'iu' and array.shape[-1:] == (3,)]
    return 'yolov3' if seen.inputs == 2 and len(seen.outputs) == 3 and whole else None


def _by_dimensions(seen: Seen) -> str | None:
    arrays = list(seen.outputs.values())
    if len(arrays) == 1 and arrays[0].ndim in (2, 4) and arrays[0].shape[-1] == 7:
        return 'yolov7_end2end' if arrays[0].ndim == 2 else 'detection_output'
    rows = [array for array in arrays if array.ndim == 3]
    if len(rows) == 2 and rows[0].shape[1] == rows[1].shape[1] and 4 in (rows[0].shape[2], rows[1].shape[2]):
        count = rows[0].shape[1]
        return 'yolo_nas' if count == _cells(seen.size) else 'detr' if count <= MOST_QUERIES else None
    return _by_rows(seen, rows[0]) if len(rows) == 1 else None


def _by_rows(seen: Seen, array: np.ndarray) -> str | None:
    """Tell by the one output [1, rows, columns]."""
    _, rows, columns = array.shape
    cells = _cells(seen.size)
    if columns == 6 and rows <= MOST_QUERIES and rows != cells:
        # six columns are also a query model of two classes; a number of a class is whole, a probability is not
        whole = (array[..., 5] == np.round(array[..., 5])).all()
        return 'end_to_end' if seen.end_to_end or whole or len(seen.names) != 2 else 'ultralytics_rtdetr'
    if rows <= MOST_QUERIES and seen.names and columns == 4 + len(seen.names):
        return 'ultralytics_rtdetr'
    if 5 <= rows < columns:
        return 'yolov8'
    if columns < 6:
        return None
    if rows == cells:
        small = np.abs(array[..., :2]).max() < 0.5 * min(seen.size)
        return 'yolox' if small else 'yolox_decoded'
    if rows in [ANCHORS * _cells(seen.size, strides) for strides in STRIDES_OF_ANCHORS]:
        return 'yolov5'
    return 'ultralytics_rtdetr' if rows <= MOST_QUERIES else None


def _cells(size: Size, strides: tuple[int, ...] = decoding.YOLOX_STRIDES) -> int:
    """Number of cells of all the grids over an input (width, height)."""
    return sum((size[0] // stride) * (size[1] // stride) for stride in strides)


def class_count(layout: str, seen: Seen) -> int | None:
    """Number of classes, None where the layout does not tell it."""
    if seen.names:
        return max(seen.names) + 1
    rows = [array for array in seen.outputs.values() if array.ndim == 3]
    masks = MASK_COLUMNS if any(array.ndim == 4 and array.shape[1] == MASK_COLUMNS
                                for array in seen.outputs.values()) else 0
    if layout in ('yolox', 'yolox_decoded', 'yolov5'):
        return rows[0].shape[2] - 5 - masks
    if layout == 'yolov8':
        return rows[0].shape[1] - 4 - masks
    if layout == 'ultralytics_rtdetr':
        return rows[0].shape[2] - 4
    if layout in ('yolo_nas', 'detr'):
        columns = boxes_and_classes(seen.outputs)[1].shape[1]
        return columns - (layout == 'detr' and columns == decoding.DETR_WITH_NONE)
    if layout == 'yolov3':
        return next(array.shape[1] for array in rows if array.dtype.kind == 'f' and array.shape[-1] != 4)
    return None
