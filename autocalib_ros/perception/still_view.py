"""One view of a camera that stands: its reference image, its rest position, and the sway about it."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np

from autocalib_ros.perception.background import median
from autocalib_ros.perception.background_motion import AGREEMENT_PX, PictureMotion, ReferenceImage
from autocalib_ros.perception.view_registration import normalised

REST_S = 10.0
"""Time over which offsets are averaged to the rest position, seconds: two periods of the slowest sway, 0.2 Hz, which a
Hann window of this length cancels."""
REST_INTERVAL_S = 1.0
"""Interval at which the rest position is found again, seconds."""
MIN_REST_SAMPLES = 3
"""Least offsets of a rest position, for streams of few images."""
MAX_OFFSETS = 1024
"""Most offsets in memory: `REST_S` at 100 images a second."""
SWAY_S = 3.0
"""Time over which sway is noticed, seconds: it comes and goes with the gusts."""
SWAY_INTERVAL_S = 0.2
"""Interval between two judgements of the sway, seconds: shorter than the fastest one, of 3 Hz."""
MIN_SWAY_SAMPLES = 8
"""Least offsets from which sway is judged: a third of a second of video."""
SWAY_QUANTILE = 0.8
"""Share of the offsets within the amplitude of sway; a sine spends a fifth of its time beyond 95 % of its amplitude."""
REPORTED_QUANTILE = 0.95
"""Share of the images within the sway that is reported."""
SWAY_ENDS = 0.7
"""Fraction of the least sway below which compensation ends: it does not flicker. Judgement."""
SWAY_SIGMAS = 4.0
"""Sway below this number of standard errors of one measurement is not compensated. Judgement: noise alone passes it in
less than one image in a thousand, and the amplitude needs a fifth of them."""
SAMPLE_INTERVAL_S, REFERENCE_SAMPLES = 1.0, 7
"""Interval and number of the reduced images whose median becomes the reference: no vehicle stands in it that drove on
within four seconds."""
WORN_SHARE = 0.6
"""Fraction of the first share of agreeing corners below which the reference is renewed: light and shadow have changed.
Judgement."""
RENEWAL_S = 30.0
"""Least interval between two renewals, seconds: light changes more slowly, and each adds an error of hundredths of a
pixel."""
MAX_ANCHORS = 4
"""References in memory that later ones are placed by, besides the first: of day, dusk and night."""
AMPLITUDE_BINS, AMPLITUDE_STEP_PX = 400, 0.05
"""Bins of the histogram of sway, and their width in pixels of the image measured in."""


class StillView:
    """Offsets of the images of one view from its reference, in pixels of the reduced image."""

    def __init__(
        self, number: int, image: np.ndarray, time_s: float, ignored: np.ndarray | None, least_sway_px: float
    ) -> None:
        self.number, self.start_s, self.newest_s = number, time_s, time_s
        self.still_s = 0.0
        """Seconds in which the view was seen and still."""
        self.position = 0j
        """Of the reference in the picture's motion through the recording, pixels."""
        self.last = PictureMotion()
        """Motion of the newest image that showed the view."""
        self.rest = PictureMotion()
        self.first_rest: PictureMotion | None = None
        """Rest position of the first `REST_S`; None until then."""
        self.drift_px = 0.0
        """Largest distance of the rest position from the first one."""
        self.is_confirmed = False
        """Whether the first rest position was one: most images of its time lie about it."""
        self._ignored, self._least_sway_px = ignored, least_sway_px
        self.reference = ReferenceImage(image, ignored)
        self.base = PictureMotion()
        """Motion of the picture from the beginning of the view to the reference."""
        self._offsets: deque[tuple[float, float, float, float, float, float]] = deque(maxlen=MAX_OFFSETS)
        self._earlier_px: deque[float] = deque(maxlen=round(REST_S / REST_INTERVAL_S))
        self._rest_due_s, self._sway_due_s, self._sample_due_s = time_s, time_s, time_s
        self._samples: list[np.ndarray] = []
        self._first_share, self._renewed_s = 0.0, -np.inf
        self._anchors: list[tuple[ReferenceImage, PictureMotion]] = []
        """References of one local contrast, by which later ones are placed, oldest first, and the motion to each."""
        self.is_swaying = False
        """Whether images are compensated."""
        self._anchor, self._anchored = PictureMotion(), False
        self._amplitudes = np.zeros(AMPLITUDE_BINS, int)

    def exclude(self, ignored: np.ndarray | None) -> None:
        """Replace the mask of pixels where the reference has no corners, uint8 (h, w)."""
        self._ignored = ignored
        self.reference = ReferenceImage(self.reference.image, ignored)
        self._anchors = [(ReferenceImage(one.image, ignored), base) for one, base in self._anchors]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the reduced image."""
        return self.reference.size

    def motion_to(self, image: np.ndarray, wide: bool = False) -> PictureMotion | None:
        """Return the motion of the picture since the view began; None if the view is not recognised.

        A `wide` search also takes images of another brightness and contrast.
        """
        if wide:
            image = _levels_matched(image, self.reference.image)
        guess = (self.rest if wide else self.last).after(self.base.inverse())
        found = self.reference.motion_to(image, guess, wide)
        return None if found is None else found.after(self.base)

    def distance_px(self, motion: PictureMotion, other: PictureMotion) -> float:
        """Return the root mean square displacement over the picture between two motions."""
        return motion.after(other.inverse()).largest_px(self.size)

    def take(self, image: np.ndarray, motion: PictureMotion, time_s: float) -> PictureMotion:
        """Take an image that shows the view; return the motion to compensate, the identity if there is none."""
        # one second at most: nobody knows what the view did in longer gaps
        self.still_s += min(max(time_s - self.newest_s, 0.0), 1.0)
        self.newest_s, self.last = time_s, motion
        shift, scale = motion.shift, motion.scale
        self._offsets.append((time_s, shift.real, shift.imag, scale.real, scale.imag, motion.sigma_px))
        if time_s >= self._rest_due_s or (self.first_rest is None and time_s >= self.start_s + REST_S):
            self._find_rest(time_s)
        if time_s >= self._sway_due_s:
            self._judge_sway(time_s)
        self._sample(image, motion, time_s)
        amplitude = self.distance_px(motion, self.rest) if self.is_swaying else 0.0
        self._amplitudes[min(int(amplitude / AMPLITUDE_STEP_PX), AMPLITUDE_BINS - 1)] += 1
        return motion.after(self._anchor.inverse()) if self.is_swaying else PictureMotion()

    def _find_rest(self, time_s: float) -> None:
        """Average the offsets of the last `REST_S` with a Hann window; all offsets alike until there are so many."""
        first = self.first_rest is None
        self._rest_due_s = time_s + (REST_INTERVAL_S / 4 if first else REST_INTERVAL_S)
        offsets = self._newest(time_s - REST_S)
        times_s = offsets[:, 0]
        full = time_s - self.start_s >= REST_S and len(offsets) >= MIN_REST_SAMPLES
        # calm views are measured less often: weigh by the time that each offset stands for
        weights = np.clip(np.diff(times_s, prepend=times_s[0] - REST_INTERVAL_S / 8), 1e-3, REST_INTERVAL_S)
        if full:
            weights = weights * (1e-3 + np.sin(np.pi * (time_s - times_s) / REST_S) ** 2)
        mean = weights @ offsets[:, 1:5] / weights.sum()
        self.rest = PictureMotion(complex(mean[0], mean[1]), complex(mean[2], mean[3]))
        if not full:
            return
        if first:
            self.first_rest = self.rest
        self._earlier_px.append(self.displacement_px)
        self.drift_px = max(self.drift_px, self.displacement_px)

    def _newest(self, since_s: float) -> np.ndarray:
        """Return the offsets since a time, at least the newest `MIN_REST_SAMPLES`, as rows of time, motion, sigma."""
        rows = np.array(self._offsets)
        return rows[min(int(np.searchsorted(rows[:, 0], since_s)), max(len(rows) - MIN_REST_SAMPLES, 0)) :]

    def _distances_px(self, offsets: np.ndarray, motion: PictureMotion) -> np.ndarray:
        """Return the distances (n,) of offsets (n, 6) from a motion, as `distance_px` to first order."""
        width, height = self.size
        spread = (width**2 + height**2) / 12.0
        shift = np.hypot(offsets[:, 1] - motion.shift.real, offsets[:, 2] - motion.shift.imag)
        scale2 = (offsets[:, 3] - motion.scale.real) ** 2 + (offsets[:, 4] - motion.scale.imag) ** 2
        return np.sqrt(shift**2 + spread * scale2)

    @property
    def displacement_px(self) -> float:
        """Distance of the rest position from the first one, pixels."""
        return 0.0 if self.first_rest is None else self.distance_px(self.rest, self.first_rest)

    @property
    def halves_px(self) -> float:
        """Distance between the means of the first and the second half of the offsets of the last `REST_S`, pixels."""
        if not self._offsets:
            return 0.0
        offsets = self._newest(self.newest_s - REST_S)
        late = offsets[:, 0] > 0.5 * (offsets[0, 0] + offsets[-1, 0])
        if late.all() or not late.any():
            return 0.0
        mean = offsets[~late].mean(axis=0)
        first = PictureMotion(complex(mean[1], mean[2]), complex(mean[3], mean[4]))
        return float(self._distances_px(offsets[late].mean(axis=0, keepdims=True), first)[0])

    @property
    def moved_px(self) -> float:
        """Distance of the offsets of the last `SWAY_S` from the first rest position, pixels."""
        recent = self._newest(self.newest_s - SWAY_S).mean(axis=0, keepdims=True)
        return float(self._distances_px(recent, self.first_rest or self.rest)[0])

    @property
    def moved_at_once(self) -> bool:
        """Whether the rest position was still near the first one `REST_S` ago: a bump, no slow drift."""
        return bool(self._earlier_px) and self._earlier_px[0] < 0.5 * self.displacement_px

    def left_s(self) -> float:
        """Return the time at which the picture left the first rest position for the one of now."""
        offsets = self._newest(-np.inf)
        near = self._distances_px(offsets, self.first_rest or self.rest) < 0.5 * self.displacement_px
        return float(offsets[np.flatnonzero(near)[-1], 0]) if near.any() else float(offsets[0, 0])

    @property
    def spread_px(self) -> float:
        """Largest distance between the rest position and the newest offsets, pixels."""
        return float(self._distances_px(self._newest(-np.inf), self.rest).max()) if self._offsets else 0.0

    def share_within(self, limit_px: float) -> float:
        """Return the fraction of the offsets of the last `REST_S` within a distance of the rest position."""
        offsets = self._newest(self.newest_s - REST_S)
        return float((self._distances_px(offsets, self.rest) <= limit_px).mean())

    def _judge_sway(self, time_s: float) -> None:
        """Compensate from where the sway, or a displacement from the pose of the evidence, exceeds its noise."""
        self._sway_due_s = time_s + SWAY_INTERVAL_S
        recent = self._newest(time_s - SWAY_S)
        if len(recent) < MIN_SWAY_SAMPLES:
            return
        middle = recent[:, 1:5].mean(axis=0)
        middle_motion = PictureMotion(complex(middle[0], middle[1]), complex(middle[2], middle[3]))
        amplitude = np.quantile(self._distances_px(recent, middle_motion), SWAY_QUANTILE)
        least = max(self._least_sway_px, SWAY_SIGMAS * float(np.median(recent[:, 5])))
        if not self._anchored:
            # the evidence so far is about the pose of the first seconds
            self._anchor, self._anchored = middle_motion, time_s - self.start_s >= SWAY_S
        displaced = self.distance_px(middle_motion, self._anchor) > 2 * least
        if amplitude > least or displaced:
            self.is_swaying = self._anchored = True
        elif amplitude < SWAY_ENDS * least:
            self.is_swaying = False

    @property
    def sway_px(self) -> float:
        """Compensated sway about the rest position: `REPORTED_QUANTILE` of the images are within, pixels; 0: none."""
        counts = np.cumsum(self._amplitudes)
        bound = int(np.searchsorted(counts, REPORTED_QUANTILE * counts[-1]))
        return (bound + 0.5) * AMPLITUDE_STEP_PX if bound else 0.0

    def _sample(self, image: np.ndarray, motion: PictureMotion, time_s: float) -> None:
        """Gather images of the rest position; make their median the reference, first soon, then where it is worn."""
        if time_s < self._sample_due_s:
            return
        self._sample_due_s = time_s + SAMPLE_INTERVAL_S
        offset = motion.after(self.rest.inverse())
        shows = motion
        if offset.largest_px(self.size) > self._least_sway_px:
            image, shows = warped(image, offset), self.rest
        self._samples = [*self._samples[1 - REFERENCE_SAMPLES :], image]
        worn = motion.share < WORN_SHARE * self._first_share and time_s - self._renewed_s >= RENEWAL_S
        if len(self._samples) == REFERENCE_SAMPLES and (self._first_share == 0.0 or worn):
            self._renew(image, shows, time_s)

    def image_of_evidence(self) -> np.ndarray:
        """Return the reference image (H, W) in the pose that the evidence of the view is in."""
        offset = self.base.after(self._anchor.inverse()) if self._anchored else PictureMotion()
        return warped(self.reference.image, offset) if offset.largest_px(self.size) > 0 else self.reference.image

    @property
    def ignored(self) -> np.ndarray | None:
        """Mask (h, w) of pixels where the reference has no corners."""
        return self._ignored

    def replace_reference(self, reference: ReferenceImage, motion: PictureMotion) -> None:
        """Take another reference, which shows a motion since the view began."""
        self.base, self.reference = motion, reference
        self._samples, self._first_share = [], 0.0

    def _renew(self, image: np.ndarray, motion: PictureMotion, time_s: float) -> None:
        """Replace the reference by the median of the samples; the newest of them shows `motion`, which goes on.

        Its place is that by the oldest reference that still recognises it. A chain from each to the next one would
        drift: shadows take the corners at their edges along, by less than agrees from one to the next, and by more than
        that from the oldest one. Where it says something else by more than agrees, it follows the shadows itself.
        """
        self._renewed_s = time_s
        reference = ReferenceImage(median(self._samples), self._ignored)
        shown = reference.motion_to(image, PictureMotion())
        if shown is None:
            return
        base, pattern = shown.inverse().after(motion), normalised(reference.image)
        for anchor, place in self._anchors:
            found = anchor.motion_to(pattern, base.after(place.inverse()))
            if found is not None and self.distance_px(found.after(place), base) < AGREEMENT_PX:
                base = found.after(place)
                break
        else:
            self._anchors = [
                *self._anchors[:1],
                *self._anchors[1:][1 - MAX_ANCHORS :],
                (ReferenceImage(pattern, self._ignored), base),
            ]
        self.reference, self._first_share, self.base = reference, shown.share, base


def warped(image: np.ndarray, motion: PictureMotion) -> np.ndarray:
    """Return an image (H, W) or (H, W, 3) moved back by the motion that it shows; its border repeats outwards."""
    size = (image.shape[1], image.shape[0])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(image, motion.matrix(size), size, flags=flags, borderMode=cv2.BORDER_REPLICATE)


def _levels_matched(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return an image (H, W) with mean and spread of the grey levels of a reference: light may have changed."""
    mean, spread = float(image.mean()), float(image.std())
    if spread < 1.0:
        return image
    gain = float(reference.std()) / spread
    return np.clip((image.astype(np.float32) - mean) * gain + float(reference.mean()) + 0.5, 0, 255).astype(np.uint8)
