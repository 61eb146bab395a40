"""Mapping of model classes to vehicles and people."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from autocalib_ros.config import DetectorOptions
from autocalib_ros.errors import UsageError

VEHICLE_NAMES = frozenset(
    (
        'bus',
        'car',
        'coach',
        'lorry',
        'minibus',
        'motor',
        'motorbike',
        'motorcycle',
        'pickup',
        'suv',
        'taxi',
        'truck',
        'van',
        'vehicle',
    )
)
PEOPLE_NAMES = frozenset(
    ('bicycle', 'bicyclist', 'bike', 'cyclist', 'pedestrian', 'people', 'person', 'rider', 'scooter')
)


@dataclass(frozen=True)
class ClassIds:
    """Class ids of vehicles, and of people including cyclists."""

    vehicles: tuple[int, ...]
    people: tuple[int, ...]


COCO_80 = ClassIds(vehicles=(2, 3, 5, 7), people=(0, 1))
COCO_91 = ClassIds(vehicles=(3, 4, 6, 8), people=(1, 2))
"""Original COCO ids with gaps, as used by the models of TensorFlow and DETR."""


def chosen_classes(options: DetectorOptions, names: Mapping[int, str], layout: str, count: int | None) -> ClassIds:
    """Return the class ids from the options, else from the names in the model, else of COCO; UsageError if none apply.

    `count` is the number of classes; None if the layout does not determine it.
    """
    vehicles, people = options.chosen_classes
    if vehicles:
        highest = max(vehicles + people)
        if count is not None and highest >= count:
            raise UsageError(
                f"class {highest} of 'detector.class_ids' is not in the model, whose classes are numbered "
                f'0 to {count - 1}'
            )
        return ClassIds(vehicles, people)
    if names:
        return _classes_by_name(names)
    if layout == 'tf_od' or (layout == 'detr' and count in (90, 91)):
        return COCO_91
    if layout != 'detection_output' and count in (80, None):
        return COCO_80
    raise UsageError(
        f'the model does not name its classes{f", {count} of them" if count else ""}: set '
        "'detector.class_ids' to the numbers of those that are vehicles"
    )


def _classes_by_name(names: Mapping[int, str]) -> ClassIds:
    words = {number: name.strip().lower() for number, name in names.items()}
    vehicles = tuple(number for number, word in sorted(words.items()) if word in VEHICLE_NAMES)
    if not vehicles:
        raise UsageError(
            f"none of the model's classes is known as a vehicle ({', '.join(words.values())[:300]}): set "
            "'detector.class_ids' to the numbers of those that are"
        )
    return ClassIds(vehicles, tuple(number for number, word in sorted(words.items()) if word in PEOPLE_NAMES))
