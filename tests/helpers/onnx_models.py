"""Detectors that are made up: they see coloured rectangles in what they are fed, and say so in a layout of their own.

A session of onnxruntime, as far as the program uses one. Blue is a car, red a person; a model reads its input the way
that its kind was trained, so that swapped colours, another range or a wrong place show.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from autocalib_ros.perception.detector.preprocessing import IMAGENET_MEAN, IMAGENET_STD

CAR, PERSON = 2, 0
"""Of COCO's 80 classes."""
COCO_91 = {CAR: 3, PERSON: 1}
OBJECT, CLASS = 0.9, 0.8
SCORE = OBJECT * CLASS
RED, BLUE = (0, 0, 230), (230, 0, 0)
Found = list[tuple[np.ndarray, int]]
"""Edges (4,) in pixels of the input, and class."""


def picture(size: tuple[int, int], boxes: dict[int, list[tuple[int, int, int, int]]]) -> np.ndarray:
    """Draw rectangles (left, top, right, bottom) by class on grey, BGR uint8, size (width, height)."""
    image = np.full((size[1], size[0], 3), 90, np.uint8)
    for kind, places in boxes.items():
        for left, top, right, bottom in places:
            image[top:bottom, left:right] = BLUE if kind == CAR else RED
    return image


@dataclass
class SeeingModel:
    """Stands for onnxruntime's InferenceSession."""

    encode: Callable[[Found, tuple[int, int]], dict[str, np.ndarray]]
    size: tuple[int | str, int | str] = (416, 416)
    order: str = 'rgb'
    white: float = 1.0
    imagenet: bool = False
    kind: str = 'tensor(float)'
    channels_last: bool = False
    size_input: tuple[str, str] | None = None
    """Name and type of a second input."""
    meta: dict[str, str] = field(default_factory=dict)
    fed: list[tuple[int, ...]] = field(default_factory=list)

    def get_inputs(self) -> list[Any]:
        """Describe the inputs."""
        width, height = self.size
        shape = [1, height, width, 3] if self.channels_last else [1, 3, height, width]
        inputs = [SimpleNamespace(name='images', shape=shape, type=self.kind)]
        if self.size_input:
            inputs.append(SimpleNamespace(name=self.size_input[0], shape=[1, 2], type=self.size_input[1]))
        return inputs

    def get_outputs(self) -> list[Any]:
        """Describe the outputs, the shapes as vaguely as some do."""
        return [
            SimpleNamespace(name=name, shape=['?'], type='tensor(float)')
            for name in self.encode([], self._size_or((64, 64)))
        ]

    def get_modelmeta(self) -> Any:
        """Return the metadata."""
        return SimpleNamespace(custom_metadata_map=self.meta)

    def run(self, _names: None, feed: dict[str, np.ndarray]) -> list[np.ndarray]:
        """Look at the input."""
        array = feed['images']
        self.fed.append(array.shape)
        assert array.dtype == {'tensor(float)': np.float32, 'tensor(uint8)': np.uint8}[self.kind]
        image = (array[0] if self.channels_last else array[0].transpose(1, 2, 0)).astype(float)
        if self.imagenet:
            image = image * IMAGENET_STD + IMAGENET_MEAN
        image = image * (255.0 / self.white)
        size = (image.shape[1], image.shape[0])
        assert all(wanted in (got, 'any') for wanted, got in zip(self.size, size, strict=True))
        if self.size_input:
            assert feed[self.size_input[0]].tolist() == [list(size if 'int' in self.size_input[1] else size[::-1])]
        rgb = image[:, :, ::-1] if self.order == 'bgr' else image
        return list(self.encode([*_seen(rgb, 0, PERSON), *_seen(rgb, 2, CAR)], size).values())

    def _size_or(self, usual: tuple[int, int]) -> tuple[int, int]:
        return tuple(side if isinstance(side, int) else other for side, other in zip(self.size, usual, strict=True))


def _seen(rgb: np.ndarray, channel: int, kind: int) -> Found:
    bright = (rgb[:, :, channel] > 160) & (rgb[:, :, 2 - channel] < 60)
    count, _, stats, _ = cv2.connectedComponentsWithStats(bright.astype(np.uint8))
    return [(np.array([x, y, x + width, y + height], float), kind) for x, y, width, height, _ in stats[1:count]]


def _centred(edges: np.ndarray) -> np.ndarray:
    return np.concatenate([(edges[:2] + edges[2:]) / 2, edges[2:] - edges[:2]])


def _classes(kind: int, count: int = 80) -> np.ndarray:
    return np.where(np.arange(count) == kind, CLASS, 0.01)


def _shares(edges: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return edges / (size * 2)


def yolox(found: Found, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """[1, A, 85]: offsets within cells, and each box a second time, as a truck that is a little less sure."""
    rows = []
    for stride in (8, 16, 32):
        columns, lines = size[0] // stride, size[1] // stride
        level = np.zeros((lines, columns, 85))
        level[..., 4:] = 0.01
        for edges, kind in found if stride == 16 else []:
            x, y, width, height = _centred(edges)
            column, line = int(x / stride), int(y / stride)
            for shift, score, of_class in ((0, OBJECT, kind), (1, OBJECT - 0.1, 7 if kind == CAR else kind)):
                cell = level[line, min(column + shift, columns - 1)]
                cell[:4] = [
                    x / stride - min(column + shift, columns - 1),
                    y / stride - line,
                    np.log(width / stride),
                    np.log(height / stride),
                ]
                cell[4], cell[5:] = score, _classes(of_class)
        rows.append(level.reshape(-1, 85))
    return {'output': np.concatenate(rows)[None].astype(np.float32)}


def yolox_decoded(found: Found, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """[1, A, 85] in pixels."""
    count = sum((size[0] // stride) * (size[1] // stride) for stride in (8, 16, 32))
    return {'output': _rows_with_objectness(found, size, count)}


def yolov5(found: Found, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """[1, 3 A, 85], and the raw heads that older exports leave behind it."""
    count = 3 * sum((size[0] // stride) * (size[1] // stride) for stride in (8, 16, 32))
    heads = {
        f'head{stride}': np.zeros((1, 3, size[1] // stride, size[0] // stride, 85), np.float32)
        for stride in (8, 16, 32)
    }
    return {'output': _rows_with_objectness(found, size, count), **heads}


def _rows_with_objectness(found: Found, size: tuple[int, int], count: int) -> np.ndarray:
    rows = np.full((count, 85), 0.01, np.float32)
    rows[:, 0], rows[:, 1] = np.linspace(0, size[0], count), np.linspace(0, size[1], count)
    for index, (edges, kind) in enumerate(found):
        rows[7 * index + 3] = [*_centred(edges), OBJECT, *_classes(kind)]
    return rows[None]


def yolov8(found: Found, size: tuple[int, int], classes: int = 80) -> dict[str, np.ndarray]:
    """[1, 4 + C, A]."""
    count = sum((size[0] // stride) * (size[1] // stride) for stride in (8, 16, 32))
    rows = np.full((count, 4 + classes), 0.01, np.float32)
    for index, (edges, kind) in enumerate(found):
        rows[5 * index + 1] = [*_centred(edges), *(_classes(kind, classes) * OBJECT)]
    return {'output0': rows.T[None]}


def yolov8_with_masks(found: Found, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """[1, 4 + C + 32, A] and [1, 32, h, w]; the coefficients of masks may be large."""
    plain = yolov8(found, size)['output0']
    return {
        'output0': np.concatenate([plain, np.full((1, 32, plain.shape[2]), 3.0, np.float32)], axis=1),
        'output1': np.zeros((1, 32, size[1] // 4, size[0] // 4), np.float32),
    }


def end_to_end(found: Found, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """[1, 300, 6]."""
    rows = np.zeros((300, 6), np.float32)
    for index, (edges, kind) in enumerate(found):
        rows[index] = [*edges, SCORE, kind]
    return {'output0': rows[None]}


def yolov7_end2end(found: Found, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """[n, 7]."""
    return {'output': np.array([[0, *edges, kind, SCORE] for edges, kind in found], np.float32).reshape(-1, 7)}


def yolov3(found: Found, size: tuple[int, int], *, tiny: bool = False) -> dict[str, np.ndarray]:
    """Boxes, y first, scores, and what is left."""
    boxes, scores = np.zeros((1, 50, 4), np.float32), np.full((1, 80, 50), 0.01, np.float32)
    for index, (edges, kind) in enumerate(found):
        boxes[0, 2 * index + 1], scores[0, kind, 2 * index + 1] = edges[[1, 0, 3, 2]], SCORE
    picked = np.array([[0, kind, 2 * index + 1] for index, (_, kind) in enumerate(found)], np.int32).reshape(-1, 3)
    return {'boxes': boxes, 'scores': scores, 'indices': picked[None] if tiny else picked}


def tiny_yolov3(found: Found, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """The same with [1, n, 3]."""
    return yolov3(found, size, tiny=True)


def rtdetr(found: Found, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """Labels, boxes and scores."""
    labels, boxes, scores = np.zeros((1, 300), np.int64), np.zeros((1, 300, 4)), np.full((1, 300), 0.01)
    for index, (edges, kind) in enumerate(found):
        labels[0, index], boxes[0, index], scores[0, index] = kind, edges, SCORE
    return {'labels': labels, 'boxes': boxes.astype(np.float32), 'scores': scores.astype(np.float32)}


def ultralytics_rtdetr(found: Found, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """[1, 300, 84], shares."""
    rows = np.full((300, 84), 0.01, np.float32)
    for index, (edges, kind) in enumerate(found):
        rows[index] = [*_centred(_shares(edges, size)), *(_classes(kind) * OBJECT)]
    return {'output0': rows[None]}


def rfdetr(found: Found, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """Shares [1, 300, 4] and logits [1, 300, 91] by COCO's own numbers."""
    boxes, logits = np.full((1, 300, 4), 0.5, np.float32), np.full((1, 300, 91), -6.0, np.float32)
    for index, (edges, kind) in enumerate(found):
        boxes[0, index] = _centred(_shares(edges, size))
        logits[0, index, COCO_91[kind]] = np.log(SCORE / (1 - SCORE))
    return {'dets': boxes, 'labels': logits}


def detr(found: Found, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """The first DETR: [1, 100, 92], the last class nothing, to be shared out."""
    boxes, logits = np.full((1, 100, 4), 0.5, np.float32), np.zeros((1, 100, 92), np.float32)
    logits[..., 91] = 12.0
    for index, (edges, kind) in enumerate(found):
        boxes[0, index] = _centred(_shares(edges, size))
        logits[0, index, COCO_91[kind]], logits[0, index, 91] = np.log(SCORE / (1 - SCORE) * 91), 0.0
    return {'pred_logits': logits, 'pred_boxes': boxes}


def yolo_nas(found: Found, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """Edges [1, A, 4] and probabilities [1, A, 80]."""
    count = sum((size[0] // stride) * (size[1] // stride) for stride in (8, 16, 32))
    boxes, scores = np.zeros((1, count, 4), np.float32), np.full((1, count, 80), 0.01, np.float32)
    for index, (edges, kind) in enumerate(found):
        boxes[0, 9 * index], scores[0, 9 * index] = edges, _classes(kind) * OBJECT
    return {'boxes': boxes, 'scores': scores}


def tf_od(found: Found, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """TensorFlow's four outputs, by COCO's own numbers, with the suffix that converters leave."""
    boxes, scores, classes = np.zeros((1, 100, 4)), np.zeros((1, 100)), np.ones((1, 100))
    for index, (edges, kind) in enumerate(found):
        boxes[0, index] = _shares(edges, size)[[1, 0, 3, 2]]
        scores[0, index], classes[0, index] = SCORE, COCO_91[kind]
    arrays = {
        'num_detections': np.array([len(found)]),
        'detection_boxes': boxes,
        'detection_scores': scores,
        'detection_classes': classes,
    }
    return {f'{name}:0': array.astype(np.float32) for name, array in arrays.items()}


def detection_output(found: Found, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """[1, 1, 200, 7]; what follows an image of -1 is rubbish."""
    rows = np.full((200, 7), 0.9, np.float32)
    rows[len(found), 0] = -1
    for index, (edges, kind) in enumerate(found):
        rows[index] = [0, COCO_91[kind], SCORE, *_shares(edges, size)]
    return {'detection_out': rows[None, None]}
