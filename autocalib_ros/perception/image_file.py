"""Read one image file, within the limits of what is decoded."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from autocalib_ros.errors import InputError
from autocalib_ros.util.picture_size import check_picture


def read_image(path: Path) -> np.ndarray:
    """Return an image file as BGR uint8 (H, W, 3); InputError if it is damaged, too large or cannot be read."""
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(f'cannot read {path}: {error.strerror or error}') from error
    try:
        check_picture(data.data)
        image = cv2.imdecode(data, cv2.IMREAD_COLOR)
    except (InputError, cv2.error) as error:
        raise InputError(f'{path} is not a readable image: {" ".join(str(error).split())}') from error
    if image is None:
        raise InputError(f'{path} is not a readable image: damaged, truncated or unsupported')
    return image
