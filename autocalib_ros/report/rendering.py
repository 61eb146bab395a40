"""Pages from their templates, and pictures inside pages."""

from __future__ import annotations

import base64
from importlib.resources import files
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment, StrictUndefined

from autocalib_ros import __version__
from autocalib_ros.report.canvas import jpeg


def template_text(name: str) -> str:
    """Return a file of the folder `templates`."""
    return (files('autocalib_ros.report') / 'templates' / name).read_text(encoding='utf-8')


def render_page(name: str, **values: Any) -> str:
    """Return the page of a template filled with values, and the version of the program."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(template_text(name)).render(version=__version__, **values)


def data_address(picture: np.ndarray, longest_px: int) -> str:
    """Return a picture as a data address, reduced to a longest side."""
    factor = min(1.0, longest_px / max(picture.shape[:2]))
    if factor < 1.0:
        height, width = picture.shape[:2]
        size = (max(1, round(factor * width)), max(1, round(factor * height)))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return 'data:image/jpeg;base64,' + base64.b64encode(jpeg(picture)).decode()
