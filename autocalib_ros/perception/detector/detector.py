"""Object detector: loads a model, infers its layout by a trial run on a grey image, and detects in camera images."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from autocalib_ros.config import DetectorOptions
from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.perception.detector.classes import chosen_classes
from autocalib_ros.perception.detector.decoding import non_maximum_suppression
from autocalib_ros.perception.detector.layouts import LAYOUTS, ModelProbe, count_classes, detect_layout
from autocalib_ros.perception.detector.preprocessing import PAD_LEVEL, ColourFormat, Placement, place_in_input, tensor
from autocalib_ros.perception.detector.session import open_session
from autocalib_ros.util.documents import printable
from autocalib_ros.util.input_limits import MAX_CLASS_TEXT, MAX_CLASSES, MAX_MODEL_SIDE_PX

MAX_INPUT_PX = 1280
"""Longest side of the input of a model with dynamic size: larger inputs take more time and find little more."""
TRIAL_SIZE = (640, 384)
"""Width and height of the trial image for such a model; not square, so that swapped sides are noticed."""
INPUT_DTYPES: dict[str, type[np.generic]] = {
    'tensor(float)': np.float32,
    'tensor(float16)': np.float16,
    'tensor(uint8)': np.uint8,
}


@dataclass(frozen=True)
class Detections:
    """Detections in one image."""

    edges_px: np.ndarray
    """Left, top, right, bottom in pixels of the image, origin at the image corner, shape (n, 4)."""
    scores: np.ndarray
    """Shape (n,)."""
    people: np.ndarray
    """True for pedestrians and cyclists, false for vehicles, shape (n,)."""


def open_detector(options: DetectorOptions) -> VehicleDetector | None:
    """Load the model given in the options; None if there is none."""
    return VehicleDetector(open_session(options), options) if options.model else None


class VehicleDetector:
    """Detects vehicles and people in images of any size; UsageError if the model is not supported."""

    def __init__(self, session: Any, options: DetectorOptions) -> None:
        self._session, self._options = session, options
        self._image_input, self._size_input = _inputs(session)
        shape = self._image_input.shape
        self._channels_last = shape[-1] == 3 and shape[1] != 3
        height, width = shape[1:3] if self._channels_last else shape[2:]
        self._model_size = _fixed_side(width), _fixed_side(height)
        if max(side or 0 for side in self._model_size) > MAX_MODEL_SIDE_PX:
            raise UsageError(
                f'the model takes images of {self._model_size[0]}x{self._model_size[1]} pixels; sides up to '
                f'{MAX_MODEL_SIDE_PX} are possible: give a detector with a smaller input'
            )
        if options.input_size and None not in self._model_size:
            raise UsageError(
                f"'detector.input_size' is for a model with dynamic input size; this one takes "
                f'{self._model_size[0]}x{self._model_size[1]}: remove the option'
            )
        probe = self._probe()
        self.layout = detect_layout(probe) if options.layout == 'auto' else options.layout
        defaults = LAYOUTS[self.layout]
        self._nms, self._decode = not defaults.needs_no_nms, defaults.decode
        self._mode = defaults.resize_mode if options.resize_mode == 'auto' else options.resize_mode
        self._colours = ColourFormat(
            order=defaults.channel_order if options.channel_order == 'auto' else options.channel_order,
            white=options.input_scale or defaults.input_scale,
            imagenet=defaults.imagenet if options.mean_std == 'auto' else options.mean_std == 'imagenet',
        )
        self._require_readable(probe)
        self._count = count_classes(self.layout, probe)
        self._classes = chosen_classes(options, probe.names, self.layout, self._count)

    def __str__(self) -> str:
        size = 'x'.join(str(side or 'any') for side in self._model_size)
        normalised = ' normalised by ImageNet' if self._colours.imagenet else ''
        return (
            f'detector of layout {self.layout}, input {size} {self._mode}, {self._colours.order} up to '
            f'{self._colours.white:g}{normalised}, vehicles are classes {_listed(self._classes.vehicles)}, people '
            f'{_listed(self._classes.people)}'
        )

    def detect(self, image: np.ndarray) -> Detections:
        """Detect vehicles and people in a grey (H, W) or BGR (H, W, 3) image, uint8, by descending score."""
        size = (image.shape[1], image.shape[0])
        placement = place_in_input(size, self._model_size, self._mode, self._options.input_size or MAX_INPUT_PX)
        try:
            outputs = self._run(image, placement)
        except Exception as error:  # onnxruntime raises many unrelated exception classes
            raise InputError(
                f'the detector failed on an image of {size[0]}x{size[1]}: {" ".join(str(error).split())[:300]}'
            ) from error
        boxes = self._decode(outputs, placement.input_size, self._count, self._options.confidence)
        boxes = boxes.subset(
            np.isin(boxes.classes, self._classes.vehicles + self._classes.people)
            & np.isfinite(boxes.edges_px).all(axis=1)
        )
        boxes = boxes.subset(np.argsort(-boxes.scores, kind='stable'))
        if self._nms:
            boxes = non_maximum_suppression(boxes, self._options.nms_iou)
        edges = np.clip(placement.to_image(boxes.edges_px), 0.0, size + size)
        visible = (edges[:, 2:] - edges[:, :2] > 1.0).all(axis=1)
        return Detections(edges[visible], boxes.scores[visible], np.isin(boxes.classes[visible], self._classes.people))

    def _run(self, image: np.ndarray, placement: Placement) -> dict[str, np.ndarray]:
        """Return the outputs by name for an image; a model with an image size input gets the size of its input."""
        feed = {
            self._image_input.name: tensor(
                image, placement, self._colours, INPUT_DTYPES[self._image_input.type], channels_last=self._channels_last
            )
        }
        if self._size_input is not None:
            # D-FINE and RT-DETR take integers, width first; YOLOv3 floats, height first
            whole = 'int' in self._size_input.type
            kind = np.int32 if 'int32' in self._size_input.type else np.int64 if whole else np.float32
            feed[self._size_input.name] = np.array([placement.input_size[:: 1 if whole else -1]], kind)
        names = [output.name.partition(':')[0] for output in self._session.get_outputs()]
        return dict(zip(names, map(np.asarray, self._session.run(None, feed)), strict=True))

    def _probe(self) -> ModelProbe:
        """Run the model on a grey image and collect its inputs, outputs and metadata."""
        longest = self._options.input_size or max(TRIAL_SIZE)
        placement = place_in_input(TRIAL_SIZE, self._model_size, 'stretch', longest)
        self._colours = ColourFormat('rgb', 1.0, imagenet=False)
        grey = np.full((placement.image_size[1], placement.image_size[0]), PAD_LEVEL, np.uint8)
        meta = dict(self._session.get_modelmeta().custom_metadata_map)
        described = '; '.join(
            f'{what} {", ".join(f"{port.name} {port.shape}" for port in ports)}'
            for what, ports in (('inputs', self._session.get_inputs()), ('outputs', self._session.get_outputs()))
        )
        try:
            outputs = self._run(grey, placement)
        except Exception as error:  # see detect
            raise UsageError(
                f'the detector failed on a grey image of {placement.input_size[0]}x'
                f'{placement.input_size[1]} ({described}): {" ".join(str(error).split())[:300]}'
            ) from error
        given = ', '.join(f'{name} {list(array.shape)}' for name, array in outputs.items())
        return ModelProbe(
            inputs=len(self._session.get_inputs()),
            outputs=outputs,
            size=placement.input_size,
            names=_names(meta),
            end_to_end=str(meta.get('end2end', '')).lower() == 'true',
            shapes=f'{described}; for {placement.input_size[0]}x{placement.input_size[1]} it gave {given}',
        )

    def _require_readable(self, probe: ModelProbe) -> None:
        """Raise UsageError unless the layout, inferred or configured, decodes the outputs of the trial run."""
        try:
            self._decode(probe.outputs, probe.size, None, 0.0)
        except (LookupError, ValueError, StopIteration) as error:
            raise UsageError(
                f"the model's outputs are not of the layout {self.layout} ({probe.shapes}): set "
                "'detector.layout' to auto or to the actual layout"
            ) from error


def _inputs(session: Any) -> tuple[Any, Any]:
    """Return the image input and the image size input, or None, of a model; UsageError for any other inputs."""
    ports = session.get_inputs()
    pictures = [port for port in ports if len(port.shape) == 4 and port.type in INPUT_DTYPES]
    sizes = [port for port in ports if len(port.shape) == 2 and port.shape[-1] == 2]
    if (
        len(pictures) != 1
        or len(pictures) + len(sizes) != len(ports)
        or 3 not in (pictures[0].shape[1], pictures[0].shape[3])
    ):
        given = ', '.join(f'{port.name} {port.shape} {port.type}' for port in ports)
        raise UsageError(f'the model must have one image input [1, 3, h, w] or [1, h, w, 3]; its inputs are {given}')
    return pictures[0], sizes[0] if sizes else None


def _names(meta: Mapping[str, str]) -> dict[int, str]:
    """Return the class names by id from the metadata of a model, a dictionary or a list as text.

    Empty if they are absent, damaged, or more than `MAX_CLASSES`.
    """
    try:
        text = meta['names']
        names = ast.literal_eval(text) if len(text) <= MAX_CLASS_TEXT else {}
        found = {
            int(number): printable(str(name))
            for number, name in (names.items() if isinstance(names, dict) else enumerate(names))
        }
    except (LookupError, ValueError, SyntaxError, TypeError, OverflowError, RecursionError, MemoryError):
        return {}
    return found if all(0 <= number < MAX_CLASSES for number in found) else {}


def _listed(numbers: tuple[int, ...]) -> str:
    return ' '.join(map(str, numbers)) or 'none'


def _fixed_side(side: Any) -> int | None:
    """Return a side of the model input in pixels; None if it is dynamic."""
    return side if isinstance(side, int) and side > 0 else None
