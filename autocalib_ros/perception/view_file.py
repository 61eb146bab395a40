"""File of the views of a calibration, by which the next start verifies that the camera stands as it did.

The images are small (640 px), grey, and medians without passing traffic; ignored regions are black. Only the owner of
the file may read it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from autocalib_ros.errors import InputError
from autocalib_ros.evidence.npz import LOAD_ERRORS
from autocalib_ros.perception.view_registration import REGISTERED_WIDTH_PX, ViewPose
from autocalib_ros.perception.view_watch import MAX_REFERENCES, KnownView
from autocalib_ros.util.files import OWNER_ONLY, replaced_atomically
from autocalib_ros.util.packed_arrays import packed_arrays

MAX_VIEW_BYTES = 4 * MAX_REFERENCES * REGISTERED_WIDTH_PX**2
"""Largest size of the unpacked file: images and masks of twice the height of a square one."""


def write_views(path: Path, belongs_to: str, views: Sequence[KnownView]) -> None:
    """Write views of one size atomically; `belongs_to` identifies their calibration. InputError if that fails."""
    shape = views[0].image.shape
    kept = [view for view in views if view.image.shape == shape]
    masks = [np.zeros(shape, np.uint8) if view.ignored is None else view.ignored for view in kept]
    with replaced_atomically(path, OWNER_ONLY) as stream:
        np.savez_compressed(
            stream,
            belongs_to=np.array(belongs_to),
            images=np.stack([view.image for view in kept]),
            ignored=np.stack(masks) > 0,
            rotations=np.stack([view.pose.rotation for view in kept]),
            covariances=np.stack([view.pose.covariance for view in kept]),
        )


def read_views(path: Path, belongs_to: str) -> tuple[KnownView, ...]:
    """Return the views of a calibration; none where the file belongs to another or there is none.

    InputError if it is damaged.
    """
    try:
        with packed_arrays(path, MAX_VIEW_BYTES) as saved:
            if str(saved['belongs_to']) != belongs_to:
                return ()
            images, ignored = saved['images'], saved['ignored']
            rotations, covariances = np.asarray(saved['rotations'], float), np.asarray(saved['covariances'], float)
    except FileNotFoundError:
        return ()
    except LOAD_ERRORS as error:
        raise InputError(f'{path}: the stored views cannot be read ({type(error).__name__}: {error})') from error
    count = len(images)
    shapes = (rotations.shape, covariances.shape, ignored.shape, images.ndim, images.dtype)
    finite = bool(np.isfinite(rotations).all() and np.isfinite(covariances).all())
    if shapes != ((count, 3, 3), (count, 4, 4), images.shape, 3, np.uint8) or not count or not finite:
        raise InputError(f'{path}: it does not hold images with a pose each, so it is no file of views')
    return tuple(
        KnownView(image, mask.astype(np.uint8) if mask.any() else None, ViewPose(rotation, 0.0, covariance))
        for image, mask, rotation, covariance in zip(images, ignored, rotations, covariances, strict=True)
    )
