"""Gaussian prior on the lens parameters: families of real lenses, and options that assert a lens.

Coefficients of Kannala & Brandt (2006) distinguish the classical projections: k = 0 is equidistant, the series of the
tangent (k1 = 1/3, k2 = 2/15, ...) is distortion-free, and roadside lenses lie near one of the two. A family is a mean
with standard deviations; a standard deviation of zero fixes a parameter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from autocalib_ros.config import JointOptions, LensOptions
from autocalib_ros.evidence.picture import Picture
from autocalib_ros.lens.camera import Camera

EQUIDISTANT = (0.0, 0.0, 0.0, 0.0)
"""Coefficients k1 to k4 of r = f theta."""
DISTORTION_FREE = (1 / 3, 2 / 15, 17 / 315, 62 / 2835)
"""Coefficients k1 to k4 of r = f tan(theta): its Taylor series."""
KANNALA_BRANDT = (1 / 6, 1 / 30, 0.0, 0.0)
KANNALA_BRANDT_SIGMA = (1 / 6, 1 / 30)
"""Mean and sigma of k1, k2 of a family that covers the range between the two above, one sigma from either."""
K2_SIGMA = 0.01
"""Standard deviation of k2 about its family: the classical projections about the equidistant one, from orthographic to
stereographic, have k2 of 0 to 0.008."""
PRINCIPAL_POINT_SIGMA_FRACTION = 0.01
"""Standard deviation of the principal point about the centre of the picture, fraction of the width of the picture,
unless the option gives pixels. Judgement."""
LOOSE_PRINCIPAL_POINT_SIGMA_FRACTION = 0.1
"""Standard deviation of the principal point, fraction of the image width, where the evidence identifies it: an image
may be cropped or digitally zoomed. Judgement."""
DATA_SHEET_SIGMA = 0.1
"""Relative standard deviation of a focal length or field of view from a data sheet, unless another is given."""
LENS_PARAMETERS = ('focal length', 'principal point x', 'principal point y', 'k1', 'k2', 'pixel aspect')
"""Names of the lens parameters, in the order of `LensPrior.sigma`."""


@dataclass(frozen=True)
class LensPrior:
    """Gaussian prior of a lens family: mean and standard deviations of the `LENS_PARAMETERS`."""

    family: str
    centre: Camera
    """Mean; its focal length is used only where `focal_known`."""
    sigma: np.ndarray
    """Of log f (inf: unknown), cx and cy in pixels, k1, k2, log pixel aspect (inf: unknown); 0: fixed, shape (6,)."""
    picture: Picture | None = None
    """The picture whose centre is the mean of the principal point; None if the lens is known."""

    view_deg: float = 0.0
    """Field of view across the image from which the focal length follows, degrees; 0 if it is given itself."""

    @property
    def focal_known(self) -> bool:
        """Whether the prior constrains the focal length."""
        return bool(np.isfinite(self.sigma[0]))

    @cached_property
    def free(self) -> np.ndarray:
        """Indices of the free parameters."""
        return np.flatnonzero(self.sigma > 0)

    @cached_property
    def units(self) -> np.ndarray:
        """Unit of each free parameter: its sigma, or 1 (of a logarithm) where that is unknown, shape (free,)."""
        return np.where(np.isfinite(self.sigma), self.sigma, 1.0)[self.free]

    def moved(self, camera: Camera, step: np.ndarray) -> Camera:
        """Return the camera moved by a step (free,) in units of the free parameters."""
        change = np.zeros(len(LENS_PARAMETERS))
        change[self.free] = step * self.units
        cx, cy = camera.principal_point_px
        k1, k2, k3, k4 = camera.k
        log_focal, right, down, more_k1, more_k2, log_aspect = change.tolist()
        return Camera(
            camera.width,
            camera.height,
            camera.focal_px * math.exp(min(max(log_focal, -1.0), 1.0)),
            (cx + right, cy + down),
            (k1 + more_k1, k2 + more_k2, k3, k4),
            camera.pixel_aspect * math.exp(min(max(log_aspect, -1.0), 1.0)),
            camera.skew,
        )

    def step(self, camera: Camera, other: Camera) -> np.ndarray:
        """Return the step (free,) by which `moved` takes a camera to another."""
        (cx, cy), (other_cx, other_cy) = camera.principal_point_px, other.principal_point_px
        change = np.array(
            [
                math.log(other.focal_px / camera.focal_px),
                other_cx - cx,
                other_cy - cy,
                other.k[0] - camera.k[0],
                other.k[1] - camera.k[1],
                math.log(other.pixel_aspect / camera.pixel_aspect),
            ]
        )
        return change[self.free] / self.units

    def deviations(self, camera: Camera) -> np.ndarray:
        """Return the deviation of each free parameter from the mean in sigmas, 0 for an unknown one, shape (free,)."""
        return np.where(self._is_known, self.step(self.centre, camera), 0.0)

    @cached_property
    def _is_known(self) -> np.ndarray:
        """Whether the mean of each free parameter is known, shape (free,)."""
        return np.isfinite(self.sigma[self.free])

    @cached_property
    def information(self) -> np.ndarray:
        """Diagonal of the prior information in units of the free parameters: 1 known, 0 unknown, shape (free,)."""
        return self._is_known.astype(float)

    def start(self, focal_px: float) -> Camera:
        """Return the mean with a starting focal length, or with the prior's own where it has one."""
        return self.centre if self.focal_known else replace(self.centre, focal_px=float(focal_px))

    def starts(self, focal_px: float) -> list[Camera]:
        """Return lenses to start from with a focal length: the mean, and both ends of a family that spans several."""
        mean = self.start(focal_px)
        if self.family != 'kannala_brandt' or self.sigma[3] <= 0:
            return [mean]
        return [mean, *(replace(mean, k=(*k[:2], 0.0, 0.0)) for k in (EQUIDISTANT, DISTORTION_FREE))]

    def with_data_sheet(self, known: LensOptions) -> LensPrior:
        """Return the prior with the focal length or the field of view of the data sheet, if either is given.

        A field of view gives each lens family a focal length of its own.
        """
        sigma = self.sigma.copy()
        if known.focal_px > 0:
            sigma[0] = known.focal_sigma_px / known.focal_px or DATA_SHEET_SIGMA
            return replace(self, centre=replace(self.centre, focal_px=known.focal_px), sigma=sigma)
        if known.hfov_deg > 0:
            sigma[0] = known.hfov_sigma_deg / known.hfov_deg or DATA_SHEET_SIGMA
            half = 0.5 * self.centre.width * self.centre.pixel_aspect
            reach = float(replace(self.centre, focal_px=1.0).radius(np.array(np.radians(known.hfov_deg) / 2)))
            return replace(
                self, centre=replace(self.centre, focal_px=half / reach), sigma=sigma, view_deg=known.hfov_deg
            )
        return self

    def with_unknown_focal(self) -> LensPrior:
        """Return the prior without a focal length or field of view."""
        sigma = self.sigma.copy()
        sigma[0] = np.inf
        return replace(self, sigma=sigma, view_deg=0.0)

    def with_fixed(self, names: tuple[str, ...]) -> LensPrior:
        """Return the prior with the parameters `names` fixed."""
        fixed = np.array([name in names for name in LENS_PARAMETERS])
        return replace(self, sigma=np.where(fixed, 0.0, self.sigma))

    def with_loose_principal_point(self) -> LensPrior:
        """Return the prior with a loose centre and free k2, unless these are fixed by an option."""
        sigma = self.with_loose_centre().sigma.copy()
        sigma[4] = max(sigma[4], K2_SIGMA) if sigma[3] > 0 else sigma[4]
        return replace(self, sigma=sigma)

    def with_loose_centre(self) -> LensPrior:
        """Return the prior of a picture that may be cut off: with a loose principal point, unless an option fixes it.

        The image circle of a fisheye shows its centre: there the principal point stays as it is.
        """
        sigma = self.sigma.copy()
        whole_circle = self.picture is not None and self.picture.circle is not None  # neither cropped nor zoomed
        loose_px = 0.0 if whole_circle else LOOSE_PRINCIPAL_POINT_SIGMA_FRACTION * self.centre.width
        loose = np.maximum(loose_px * np.array([1.0, self.centre.pixel_aspect]), sigma[1:3])
        sigma[1:3] = np.where(sigma[1:3] > 0, loose, 0.0)
        return replace(self, sigma=sigma)

    def with_pixel_aspect(self, aspect: float, sigma: float) -> LensPrior:
        """Return the prior with another mean of the pixel aspect, and a standard deviation of its logarithm.

        The principal point stays as certain across the image, and down the image in the same lengths on the sensor.
        """
        sigmas = self.sigma.copy()
        sigmas[2] *= aspect / self.centre.pixel_aspect
        sigmas[5] = sigma
        return replace(self, centre=replace(self.centre, pixel_aspect=aspect), sigma=sigmas)

    def with_free_k2(self) -> LensPrior:
        """Return the prior with k2 free about its mean."""
        sigma = self.sigma.copy()
        sigma[4] = K2_SIGMA
        return replace(self, sigma=sigma)


def known_lens(lens: Camera) -> LensPrior:
    """Return the prior of a known lens: all parameters fixed."""
    return LensPrior('known', lens, np.zeros(len(LENS_PARAMETERS)))


def lens_priors(
    image_size: tuple[int, int],
    options: JointOptions,
    picture: Picture | None = None,
    pixel_aspect: float = 1.0,
    known: LensOptions | None = None,
) -> list[LensPrior]:
    """Return the priors of the lens families to choose from, the most common one first.

    The principal point is that of the picture inside the images, which by default fills them.
    """
    picture = picture or Picture.whole(image_size)
    point_x, point_y = _principal_point_sigma_px(picture, options.principal_point_sigma_px, pixel_aspect)
    focal = options.focal_prior_px
    log_focal = options.focal_sigma_px / focal if focal > 0 else np.inf
    families = {
        'equidistant': (EQUIDISTANT, (options.k1_sigma, 0.0)),
        'distortion_free': (DISTORTION_FREE, (options.k1_sigma, 0.0)),
        'kannala_brandt': (KANNALA_BRANDT, KANNALA_BRANDT_SIGMA),
    }
    names = list(families) if options.lens_prior == 'auto' else [options.lens_prior]
    start_px = focal if focal > 0 else float(image_size[0])
    centre = Camera(*image_size, start_px, picture.lens_centre_px, pixel_aspect=pixel_aspect)
    priors = [
        LensPrior(
            name,
            replace(centre, k=families[name][0]),
            np.array([log_focal, point_x, point_y, *families[name][1], 0.0]),
            picture,
        )
        for name in names
    ]
    return priors if known is None else [prior.with_data_sheet(known) for prior in priors]


def _principal_point_sigma_px(picture: Picture, given_px: float, pixel_aspect: float) -> tuple[float, float]:
    """Return the standard deviations x and y of the principal point; one that is given (not negative) holds as it is.

    A picture that looks cut, in square pixels, adds the distance that its centre may have from that of the lens.
    """
    if given_px >= 0:
        return given_px, given_px * pixel_aspect
    own = PRINCIPAL_POINT_SIGMA_FRACTION * (picture.size[0] if picture.circle is None else picture.image_size[0])
    width, height = picture.image_size
    across, down = picture.scaled(pixel_aspect, 1.0, (max(round(width * pixel_aspect), 1), height)).centre_sigma_px
    return float(np.hypot(own, across / pixel_aspect)), float(np.hypot(own * pixel_aspect, down))
