"""Decode detector outputs to boxes, one function per output layout.

Each takes the outputs by name, the input size (width, height), the number of classes and the least score. Boxes are
left, top, right, bottom in pixels of the input, with the origin at the image corner, not at a pixel centre.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np

Outputs = Mapping[str, np.ndarray]
Size = tuple[int, int]
YOLOX_STRIDES = (8, 16, 32)
"""Strides of the grids of YOLOX, pixels."""
DETR_CLASSES_WITH_BACKGROUND = 92
"""Number of classes of the original DETR: with a background class and softmax; its successors use sigmoids."""


@dataclass(frozen=True)
class Boxes:
    """Detections of one image."""

    edges_px: np.ndarray
    """Left, top, right, bottom, shape (n, 4)."""
    scores: np.ndarray
    """0 to 1, shape (n,)."""
    classes: np.ndarray
    """Shape (n,)."""

    def __len__(self) -> int:
        return len(self.scores)

    def subset(self, keep: np.ndarray) -> Boxes:
        """Return the boxes that `keep`, a mask or indices (n,), selects."""
        return Boxes(self.edges_px[keep], self.scores[keep], self.classes[keep])


Decode = Callable[[Outputs, Size, int | None, float], Boxes]


def non_maximum_suppression(boxes: Boxes, iou: float) -> Boxes:
    """Drop boxes with an IoU above `iou` with a better one, across classes: a van may be detected as car and truck."""
    left_top, right_bottom = boxes.edges_px[:, :2], boxes.edges_px[:, 2:]
    kept = cv2.dnn.NMSBoxes(np.hstack([left_top, right_bottom - left_top]).tolist(), boxes.scores.tolist(), 0.0, iou)
    return boxes.subset(np.array(kept, int).ravel())


def yolox_grid(size: Size) -> np.ndarray:
    """Return column, row and stride in pixels of each grid cell, shape (cells, 3), in the order of YOLOX."""
    width, height = size
    levels = []
    for stride in YOLOX_STRIDES:
        rows, columns = np.indices((height // stride, width // stride))
        levels.append(np.column_stack([columns.ravel(), rows.ravel(), np.full(rows.size, stride)]))
    return np.concatenate(levels).astype(float)


def yolox(outputs: Outputs, size: Size, count: int | None, min_score: float) -> Boxes:
    """Decode rows of offsets in grid cells, logarithms of sizes, objectness, classes: [1, A, 5 + C]."""
    rows = _output_of_rank(outputs, 3)[0]
    likely = rows[:, 4] >= min_score
    rows, cells = rows[likely].astype(float), yolox_grid(size)[likely]
    stride = cells[:, 2:]
    with np.errstate(over='ignore'):  # overflow means another layout
        sizes = np.exp(rows[:, 2:4]) * stride
    return _with_objectness(_edges_from_centres((rows[:, :2] + cells[:, :2]) * stride, sizes), rows, count, min_score)


def yolov5(outputs: Outputs, size: Size, count: int | None, min_score: float) -> Boxes:
    """Decode rows of centre, size, objectness, classes: [1, rows, 5 + C]."""
    rows = _output_of_rank(outputs, 3)[0]
    rows = rows[rows[:, 4] >= min_score].astype(float)
    return _with_objectness(_edges_from_centres(rows[:, :2], rows[:, 2:4]), rows, count, min_score)


def yolov8(outputs: Outputs, size: Size, count: int | None, min_score: float) -> Boxes:
    """Decode columns of centre, size, classes: [1, 4 + C, A]; masks may follow the classes."""
    rows = _output_of_rank(outputs, 3)[0].T
    return _best_class(
        _edges_from_centres(rows[:, :2], rows[:, 2:4]), rows[:, 4 : None if count is None else 4 + count], min_score
    )


def end_to_end(outputs: Outputs, size: Size, count: int | None, min_score: float) -> Boxes:
    """Decode rows of edges, score, class: [1, 300, 6]."""
    rows = _output_of_rank(outputs, 3)[0]
    return _above_score(Boxes(rows[:, :4], rows[:, 4], rows[:, 5]), min_score)


def yolov7_end2end(outputs: Outputs, size: Size, count: int | None, min_score: float) -> Boxes:
    """Decode rows of image, edges, class, score: [n, 7]."""
    rows = _output_of_rank(outputs, 2)
    return _above_score(Boxes(rows[:, 1:5], rows[:, 6], rows[:, 5]), min_score)


def yolov3(outputs: Outputs, size: Size, count: int | None, min_score: float) -> Boxes:
    """Decode edges, y first [1, M, 4], scores [1, C, M] and selected (image, class, box): [n, 3] or [1, n, 3]."""
    picked = next(array for array in outputs.values() if array.dtype.kind in 'iu').reshape(-1, 3)
    edges, scores = boxes_and_classes({name: array for name, array in outputs.items() if array.dtype.kind == 'f'})
    picked = picked[(picked >= 0).all(axis=1)]
    return _above_score(
        Boxes(edges[picked[:, 2]][:, [1, 0, 3, 2]], scores[picked[:, 1], picked[:, 2]], picked[:, 1]), min_score
    )


def yolo_nas(outputs: Outputs, size: Size, count: int | None, min_score: float) -> Boxes:
    """Decode edges [1, A, 4] and probabilities [1, A, C]."""
    edges, scores = boxes_and_classes(outputs)
    return _best_class(edges, scores, min_score)


def rtdetr(outputs: Outputs, size: Size, count: int | None, min_score: float) -> Boxes:
    """Decode labels [1, Q], edges [1, Q, 4] in pixels of the size passed to the model, scores [1, Q]."""
    return _above_score(Boxes(outputs['boxes'][0], outputs['scores'][0], outputs['labels'][0]), min_score)


def ultralytics_rtdetr(outputs: Outputs, size: Size, count: int | None, min_score: float) -> Boxes:
    """Decode rows of centre and size as fractions of the input, probabilities: [1, 300, 4 + C]."""
    rows = _output_of_rank(outputs, 3)[0]
    return _best_class(_edges_from_centres(rows[:, :2] * size, rows[:, 2:4] * size), rows[:, 4:], min_score)


def detr(outputs: Outputs, size: Size, count: int | None, min_score: float) -> Boxes:
    """Decode centre and size as fractions of the input [1, Q, 4] and logits [1, Q, K]."""
    centres, logits = boxes_and_classes(outputs)
    logits = logits.astype(float)
    if logits.shape[1] == DETR_CLASSES_WITH_BACKGROUND:
        raised = np.exp(logits - logits.max(axis=1, keepdims=True))
        scores = (raised / raised.sum(axis=1, keepdims=True))[:, :-1]
    else:
        scores = 1.0 / (1.0 + np.exp(-logits))
    return _best_class(_edges_from_centres(centres[:, :2] * size, centres[:, 2:] * size), scores, min_score)


def tf_od(outputs: Outputs, size: Size, count: int | None, min_score: float) -> Boxes:
    """Decode the TensorFlow object detection API: edges, y first, as fractions of the input."""
    edges = outputs['detection_boxes'][0][:, [1, 0, 3, 2]]
    return _above_score(
        Boxes(edges * (size + size), outputs['detection_scores'][0], outputs['detection_classes'][0]), min_score
    )


def detection_output(outputs: Outputs, size: Size, count: int | None, min_score: float) -> Boxes:
    """Decode rows of image, class, score, edges as fractions of the input [1, 1, N, 7]; a negative image ends them."""
    rows = _output_of_rank(outputs, 4)[0, 0]
    rows = rows[: int(np.argmax(rows[:, 0] < 0))] if (rows[:, 0] < 0).any() else rows
    return _above_score(Boxes(rows[:, 3:] * (size + size), rows[:, 2], rows[:, 1]), min_score)


def boxes_and_classes(outputs: Outputs) -> tuple[np.ndarray, np.ndarray]:
    """Return boxes (n, 4) and class scores or logits (n, C) of the two outputs with equal length."""
    both = [array for array in outputs.values() if array.ndim == 3]
    first = next(index for index, array in enumerate(both) if array.shape[-1] == 4)
    return both[first][0], both[1 - first][0]


def _output_of_rank(outputs: Outputs, dimensions: int) -> np.ndarray:
    """Return the output with this number of dimensions; others, such as masks or training heads, hold no boxes."""
    return next(array for array in outputs.values() if array.ndim == dimensions)


def _edges_from_centres(centres: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    return np.hstack([centres - 0.5 * sizes, centres + 0.5 * sizes])


def _with_objectness(edges: np.ndarray, rows: np.ndarray, count: int | None, min_score: float) -> Boxes:
    """Return boxes scored by objectness times the best class score."""
    return _best_class(edges, rows[:, 4:5] * rows[:, 5 : None if count is None else 5 + count], min_score)


def _best_class(edges: np.ndarray, scores: np.ndarray, min_score: float) -> Boxes:
    """Return each box with its best class, of scores (n, C), if that reaches the least score."""
    keep = np.flatnonzero(scores.max(axis=1, initial=0.0) >= min_score)
    classes = scores[keep].argmax(axis=1) if len(keep) else np.zeros(0, int)
    return _above_score(Boxes(edges[keep], scores[keep, classes], classes), min_score)


def _above_score(boxes: Boxes, min_score: float) -> Boxes:
    kept = boxes.subset(boxes.scores >= min_score)
    return Boxes(kept.edges_px.astype(float), kept.scores.astype(float), np.round(kept.classes).astype(int))
