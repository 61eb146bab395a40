"""Output layouts of detectors, and how to recognise them by the names, shapes and values of their outputs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.errors import UsageError
from autocalib_ros.perception.detector import decoding
from autocalib_ros.perception.detector.decoding import Decode, Outputs, Size, boxes_and_classes

MAX_QUERIES = 1000
"""Most rows of an output after selection by the model, a few hundred; raw outputs have thousands."""
MASK_COLUMNS = 32
"""Mask coefficients that a segmentation model appends to the classes."""
ANCHORS_PER_CELL = 3
"""Anchor boxes per grid cell of the YOLOv5 family."""
ANCHOR_STRIDES = ((8, 16, 32), (8, 16, 32, 64), (16, 32))
"""Strides of the grids of the variants of the YOLOv5 family, pixels."""


@dataclass(frozen=True)
class Layout:
    """Decoder and default preprocessing of one layout; options override them."""

    decode: Decode
    resize_mode: str
    needs_no_nms: bool = False
    """The model outputs one box per object."""
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
    'end_to_end': Layout(decoding.end_to_end, 'centred', needs_no_nms=True),
    'yolo_nas': Layout(decoding.yolo_nas, 'top_left'),
    'rtdetr': Layout(decoding.rtdetr, 'stretch', needs_no_nms=True),
    'ultralytics_rtdetr': Layout(decoding.ultralytics_rtdetr, 'stretch', needs_no_nms=True),
    'detr': Layout(decoding.detr, 'stretch', needs_no_nms=True, imagenet=True),
    'tf_od': Layout(decoding.tf_od, 'stretch', needs_no_nms=True, input_scale=255.0),
    'detection_output': Layout(
        decoding.detection_output, 'stretch', needs_no_nms=True, channel_order='bgr', input_scale=255.0
    ),
}


@dataclass(frozen=True)
class ModelProbe:
    """Properties of a model: metadata of its file and the outputs of a trial run on a grey image."""

    inputs: int
    outputs: Outputs
    size: Size
    """Width and height of the model input in the trial run."""
    names: dict[int, str]
    """Class names by id; empty if the model does not name them."""
    end_to_end: bool
    """Stated in the metadata."""
    shapes: str
    """Inputs and outputs as text for error messages."""


def detect_layout(probe: ModelProbe) -> str:
    """Return the name of the layout; UsageError with the shapes if it is unknown."""
    found = _layout_by_name(probe) or _by_dimensions(probe)
    if found:
        return found
    if all(array.ndim in (4, 5) for array in probe.outputs.values()):
        raise UsageError(
            f'the model outputs raw heads, which need anchors to decode ({probe.shapes}): '
            'export it with its detection layer'
        )
    raise UsageError(
        f"the model's layout is unknown ({probe.shapes}): set 'detector.layout', or export it as one of "
        f'{", ".join(LAYOUTS)}'
    )


def _layout_by_name(probe: ModelProbe) -> str | None:
    names = set(probe.outputs)
    if {'detection_boxes', 'detection_scores', 'detection_classes'} <= names:
        return 'tf_od'
    if probe.inputs == 2 and {'labels', 'boxes', 'scores'} <= names:
        return 'rtdetr'
    whole = [array for array in probe.outputs.values() if array.dtype.kind in 'iu' and array.shape[-1:] == (3,)]
    return 'yolov3' if probe.inputs == 2 and len(probe.outputs) == 3 and whole else None


def _by_dimensions(probe: ModelProbe) -> str | None:
    arrays = list(probe.outputs.values())
    if len(arrays) == 1 and arrays[0].ndim in (2, 4) and arrays[0].shape[-1] == 7:
        return 'yolov7_end2end' if arrays[0].ndim == 2 else 'detection_output'
    rows = [array for array in arrays if array.ndim == 3]
    if len(rows) == 2 and rows[0].shape[1] == rows[1].shape[1] and 4 in (rows[0].shape[2], rows[1].shape[2]):
        count = rows[0].shape[1]
        return 'yolo_nas' if count == _cells(probe.size) else 'detr' if count <= MAX_QUERIES else None
    return _by_rows(probe, rows[0]) if len(rows) == 1 else None


def _by_rows(probe: ModelProbe, array: np.ndarray) -> str | None:
    """Return the layout of a single output [1, rows, columns]; None if unknown."""
    _, rows, columns = array.shape
    cells = _cells(probe.size)
    if columns == 6 and rows <= MAX_QUERIES and rows != cells:
        # six columns may also be a query model of two classes: class ids are integers, probabilities are not
        whole = (array[..., 5] == np.round(array[..., 5])).all()
        return 'end_to_end' if probe.end_to_end or whole or len(probe.names) != 2 else 'ultralytics_rtdetr'
    if rows <= MAX_QUERIES and probe.names and columns == 4 + len(probe.names):
        return 'ultralytics_rtdetr'
    if 5 <= rows < columns:
        return 'yolov8'
    if columns < 6:
        return None
    if rows == cells:
        small = np.abs(array[..., :2]).max() < 0.5 * min(probe.size)
        return 'yolox' if small else 'yolox_decoded'
    if rows in [ANCHORS_PER_CELL * _cells(probe.size, strides) for strides in ANCHOR_STRIDES]:
        return 'yolov5'
    return 'ultralytics_rtdetr' if rows <= MAX_QUERIES else None


def _cells(size: Size, strides: tuple[int, ...] = decoding.YOLOX_STRIDES) -> int:
    """Return the number of cells of all grids over an input (width, height)."""
    return sum((size[0] // stride) * (size[1] // stride) for stride in strides)


def count_classes(layout: str, probe: ModelProbe) -> int | None:
    """Return the number of classes; None if the layout does not determine it."""
    if probe.names:
        return max(probe.names) + 1
    rows = [array for array in probe.outputs.values() if array.ndim == 3]
    masks = (
        MASK_COLUMNS
        if any(array.ndim == 4 and array.shape[1] == MASK_COLUMNS for array in probe.outputs.values())
        else 0
    )
    if layout in ('yolox', 'yolox_decoded', 'yolov5'):
        return rows[0].shape[2] - 5 - masks
    if layout == 'yolov8':
        return rows[0].shape[1] - 4 - masks
    if layout == 'ultralytics_rtdetr':
        return rows[0].shape[2] - 4
    if layout in ('yolo_nas', 'detr'):
        columns = boxes_and_classes(probe.outputs)[1].shape[1]
        return columns - (layout == 'detr' and columns == decoding.DETR_CLASSES_WITH_BACKGROUND)
    if layout == 'yolov3':
        return next(array.shape[1] for array in rows if array.dtype.kind == 'f' and array.shape[-1] != 4)
    return None
