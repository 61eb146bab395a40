"""Faults of time stamps, as drivers, recorders and networks make them, applied to the true times of exposure.

Each fault takes the exposures' times in nanoseconds (n,), increasing and about even, and a random generator. It
returns the images that arrive, in their order of arrival, with the stamps that they carry.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from autocalib_ros.perception.header_stamps import HeaderStamps

SECOND_NS, MILLISECOND_NS = 1_000_000_000, 1_000_000
RARE_S = 5.0
"""Seconds between two faults of the kinds that happen now and then: often enough for a recording of 30 s."""
MEAN_DELAY = 0.3
"""Mean delay of the receipt of an image, frame intervals."""
BURST = 10
"""Images that arrive together in the burst faults: a third of a second at 30 Hz, a short stall of a network."""


@dataclass(frozen=True)
class StampedImages:
    """Images that arrive, in order of arrival."""

    images: np.ndarray
    """Index of each among the exposures, shape (m,)."""
    stamps_ns: np.ndarray
    """The stamp that each carries, int64, shape (m,)."""
    seconds: np.ndarray | None = None
    """Whole seconds in the header of each message, the rest is nanoseconds; None: those of the stamp."""


StampFault = Callable[[np.ndarray, np.random.Generator], StampedImages]


def even(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """Stamp each image with the time of its exposure."""
    return _all(exposures_ns)


def jitter(fraction: float) -> StampFault:
    """Return a fault: time of receipt with normal jitter, standard deviation in fractions of the frame interval."""

    def fault(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
        noise = random.normal(0.0, fraction * _period_ns(exposures_ns), len(exposures_ns))
        return _all(_in_order(exposures_ns + noise))

    return fault


def late_jitter(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """Stamp on receipt, with delays of exponential distribution: most images in time, a few very late."""
    return _all(received(exposures_ns, random))


def unsorted_jitter(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """Add normal jitter of 30 % of a frame without keeping the stamps in order."""
    return _all(exposures_ns + random.normal(0.0, 0.3 * _period_ns(exposures_ns), len(exposures_ns)))


def early_doublets(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """Stamp three images 1 ms after the one before: in the second second, and again every `RARE_S`."""
    stamps = exposures_ns.copy()
    for first in _now_and_then(exposures_ns, after_s=1.4):
        for image in (first, first + 5, first + 9):
            if 0 < image < len(stamps):
                stamps[image] = stamps[image - 1] + MILLISECOND_NS
    return _all(stamps)


def queued_doublets(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """Every eighth image waits for the next and arrives 1 ms before it."""
    stamps = exposures_ns.copy()
    stamps[7:-1:8] = stamps[8::8][: len(stamps[7:-1:8])] - MILLISECOND_NS
    return _all(stamps)


def triplets(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """Three images in a row come 1 ms after the one before, every `RARE_S`."""
    stamps = exposures_ns.copy()
    for first in _now_and_then(exposures_ns, after_s=1.4):
        for image in range(max(first, 1), min(first + 3, len(stamps))):
            stamps[image] = stamps[image - 1] + MILLISECOND_NS
    return _all(stamps)


def bursts(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """All images come in bursts of ten: each waits for the last of its ten, then they follow at 0.5 ms."""
    return _all(_delayed(exposures_ns, range(0, len(exposures_ns), BURST)))


def rare_bursts(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """Every `RARE_S` the network stalls and ten images come together."""
    return _all(_delayed(exposures_ns, _now_and_then(exposures_ns, after_s=2.0)))


def dropped(count: int) -> StampFault:
    """Return a fault: every `RARE_S` this number of images in a row is lost."""

    def fault(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
        kept = np.ones(len(exposures_ns), bool)
        for first in _now_and_then(exposures_ns, after_s=2.0):
            kept[first : first + count] = False
        return _some(exposures_ns, kept)

    return fault


def dropped_at_random(share: float) -> StampFault:
    """Return a fault: this share of the images is lost, at random."""

    def fault(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
        return _some(exposures_ns, random.random(len(exposures_ns)) >= share)

    return fault


def dropped_and_late(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """Lose a tenth of the images at random; the others have jitter of 15 % of a frame."""
    noisy = _in_order(exposures_ns + random.normal(0.0, 0.15 * _period_ns(exposures_ns), len(exposures_ns)))
    return _some(noisy, random.random(len(exposures_ns)) >= 0.1)


def alternating(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """Alternate intervals of 0.54 and 1.46 frames, as dumps of RTSP streams do (18 and 49 ms at 30 Hz)."""
    return _all(exposures_ns + (np.arange(len(exposures_ns)) % 2) * -0.46 * _period_ns(exposures_ns))


def quantised(step_ns: int) -> StampFault:
    """Return a fault: stamps cut to whole steps."""

    def fault(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
        return _all(exposures_ns // step_ns * step_ns)

    return fault


def one_ahead(by_s: float) -> StampFault:
    """Return a fault: the stamp of one image, in the middle, is ahead by `by_s`."""

    def fault(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
        stamps = exposures_ns.copy()
        stamps[len(stamps) // 2] += int(by_s * SECOND_NS)
        return _all(stamps)

    return fault


def zeros(every: int) -> StampFault:
    """Return a fault: one image in `every` has the stamp zero."""

    def fault(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
        stamps = exposures_ns.copy()
        stamps[every // 2 :: every] = 0
        return _all(stamps)

    return fault


def constant(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """All images carry the stamp of the first."""
    return _all(np.full_like(exposures_ns, exposures_ns[0]))


def stopped(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """Let the clock stop for the second quarter of the images and then go on correctly."""
    stamps = exposures_ns.copy()
    stamps[len(stamps) // 4 : len(stamps) // 2] = stamps[len(stamps) // 4]
    return _all(stamps)


def wrapped(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """Count nanoseconds in 32 bits, so that the stamps start again every 4.3 s."""
    return _all(exposures_ns % 2**32)


def wrapped_in_seconds(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """Right seconds with nanoseconds of the whole time in 32 bits, as a cast of the total to uint32 gives."""
    seconds = exposures_ns // SECOND_NS
    return replace(_all(seconds * SECOND_NS + exposures_ns % 2**32), seconds=seconds)


def stepped(by_s: float) -> StampFault:
    """Return a fault: the clock is set by `by_s` in the middle, while the images go on (NTP, or TAI to UTC)."""

    def fault(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
        stamps = exposures_ns.copy()
        stamps[len(stamps) // 2 :] += int(by_s * SECOND_NS)
        return _all(stamps)

    return fault


def rate_halved(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """Halve the rate in the middle third, as auto exposure does at night."""
    numbers, third = np.arange(len(exposures_ns)), len(exposures_ns) // 3
    return _some(exposures_ns, (numbers < third) | (numbers >= 2 * third) | (numbers % 2 == 0))


def pause(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """Stop the stream for `RARE_S` in the middle."""
    middle_ns = exposures_ns[len(exposures_ns) // 2]
    return _some(exposures_ns, ~((exposures_ns > middle_ns) & (exposures_ns < middle_ns + RARE_S * SECOND_NS)))


def cut(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """Leave out the images that `pause` lacks and stamp the others evenly."""
    arrived = pause(exposures_ns, random)
    return replace(arrived, stamps_ns=exposures_ns[: len(arrived.images)])


def overtaken(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """Swap every fortieth image with the next; the stamps are right."""
    order = np.arange(len(exposures_ns))
    for first in range(20, len(order) - 1, 40):
        order[[first, first + 1]] = order[[first + 1, first]]
    return StampedImages(order, exposures_ns[order])


def sent_twice(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """Send every tenth image twice, with its stamp."""
    order = np.sort(np.concatenate([np.arange(len(exposures_ns)), np.arange(5, len(exposures_ns), 10)]))
    return StampedImages(order, exposures_ns[order])


def started_again(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """Restart the stamps at their beginning in the middle, as a recording in a loop does; the images go on."""
    stamps = exposures_ns.copy()
    stamps[len(stamps) // 2 :] -= stamps[len(stamps) // 2] - stamps[0]
    return _all(stamps)


def second_half(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
    """Keep the images from the middle on: those that count where the evidence is reset in the middle."""
    return _some(exposures_ns, np.arange(len(exposures_ns)) >= len(exposures_ns) // 2)


STAMP_FAULTS: dict[str, StampFault] = {
    'even': even,
    'jitter_20': jitter(0.2),
    'jitter_30': jitter(0.3),
    'unsorted_jitter_30': unsorted_jitter,
    'late_jitter': late_jitter,
    'early_doublets': early_doublets,
    'queued_doublets': queued_doublets,
    'triplets': triplets,
    'bursts_of_10': bursts,
    'rare_bursts_of_10': rare_bursts,
    'dropped_1': dropped(1),
    'dropped_2': dropped(2),
    'dropped_10': dropped(10),
    'dropped_half': dropped_at_random(0.5),
    'dropped_and_late': dropped_and_late,
    'alternating': alternating,
    'milliseconds': quantised(MILLISECOND_NS),
    'seconds': quantised(SECOND_NS),
    'one_ahead_10_min': one_ahead(600.0),
    'one_ahead_2_days': one_ahead(2 * 86400.0),
    'one_zero_in_45': zeros(45),
    'constant': constant,
    'stopped': stopped,
    'wrapped': wrapped,
    'wrapped_in_seconds': wrapped_in_seconds,
    'ntp_forward_0.1': stepped(0.1),
    'ntp_back_0.1': stepped(-0.1),
    'ntp_forward_1': stepped(1.0),
    'ntp_back_1': stepped(-1.0),
    'ntp_back_5': stepped(-5.0),
    'tai_to_utc': stepped(-37.0),
    'utc_to_tai': stepped(37.0),
    'rate_halved': rate_halved,
    'pause': pause,
    'overtaken': overtaken,
    'sent_twice': sent_twice,
    'started_again': started_again,
}
"""Faults by name."""
MESSAGE_FAULTS = ('seconds', 'constant', 'stopped', 'wrapped_in_seconds')
"""Faults that need a message to be mended: its time of receipt, or the nanoseconds in its header."""


def by_message(fault: StampFault) -> StampFault:
    """Return a fault as it comes from messages, whose headers and times of receipt `HeaderStamps` reads."""

    def read(exposures_ns: np.ndarray, random: np.random.Generator) -> StampedImages:
        arrived = fault(exposures_ns, random)
        seconds = arrived.stamps_ns // SECOND_NS if arrived.seconds is None else arrived.seconds
        nanoseconds = arrived.stamps_ns - seconds * SECOND_NS
        receipts_ns = received(exposures_ns, random)[arrived.images].astype(np.int64)
        headers = HeaderStamps(lambda text: None)
        rows = np.column_stack([seconds, nanoseconds, receipts_ns]).tolist()
        return StampedImages(arrived.images, np.array([headers.choose(*row) for row in rows], np.int64))

    return read


class StampedSource(Protocol):
    """What `RestampedSource` needs of a recording."""

    def frames(self) -> Iterator[Any]:
        """Yield dataclasses with the field `stamp_ns`."""

    def stored(self) -> Iterator[Any]:
        """Yield dataclasses with the field `stamp_ns`, in the same order."""


class RestampedSource:
    """A recording whose images carry the stamps of a fault; everything else is that of the recording.

    Images that the fault moves by more than one place in the order are not supported. `epoch_ns` is added to the
    exposures first: videos begin at zero.
    """

    def __init__(self, source: StampedSource, fault: StampFault, seed: int = 0, epoch_ns: int = 0) -> None:
        self._source = source
        exposures_ns = np.array([stored.stamp_ns for stored in source.stored()], np.int64) + epoch_ns
        self.arrived = fault(exposures_ns, np.random.default_rng(seed))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def frames(self) -> Iterator[Any]:
        """Yield the frames that arrive, in order of arrival, with their stamps."""
        frames, read = self._source.frames(), 0
        recent: dict[int, Any] = {}
        for image, stamp_ns in zip(self.arrived.images.tolist(), self.arrived.stamps_ns.tolist(), strict=True):
            while read <= image:
                recent[read], read = next(frames), read + 1
            recent = {number: frame for number, frame in recent.items() if number >= image - 1}
            yield replace(recent[image], stamp_ns=stamp_ns)


def received(exposures_ns: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return times of receipt (n,) of images that come in order, with delays of exponential distribution."""
    return _in_order(exposures_ns + random.exponential(MEAN_DELAY * _period_ns(exposures_ns), len(exposures_ns)))


def _period_ns(exposures_ns: np.ndarray) -> float:
    return float(np.median(np.diff(exposures_ns)))


def _all(stamps_ns: np.ndarray) -> StampedImages:
    return StampedImages(np.arange(len(stamps_ns)), np.asarray(stamps_ns).astype(np.int64))


def _some(stamps_ns: np.ndarray, kept: np.ndarray) -> StampedImages:
    return StampedImages(np.flatnonzero(kept), np.asarray(stamps_ns)[kept].astype(np.int64))


def _in_order(arrivals_ns: np.ndarray) -> np.ndarray:
    """Return times of arrival where none overtakes another: what is overtaken waits, then follows by 0.1 ms."""
    step = 0.1 * MILLISECOND_NS * np.arange(len(arrivals_ns))
    return np.maximum.accumulate(arrivals_ns - step) + step


def _delayed(exposures_ns: np.ndarray, firsts: Any) -> np.ndarray:
    """Return the stamps if from each of `firsts` on ten images wait for the last of the ten."""
    stamps = exposures_ns.astype(np.int64)
    for first in firsts:
        part = stamps[first : first + BURST]
        part[:] = part[-1] + np.arange(len(part)) * MILLISECOND_NS // 2
    return stamps


def _now_and_then(exposures_ns: np.ndarray, after_s: float) -> list[int]:
    """Return the index of the first image `after_s` after the start, and of those every `RARE_S` after it."""
    seconds = (exposures_ns - exposures_ns[0]) / SECOND_NS
    return [int(np.searchsorted(seconds, moment)) for moment in np.arange(after_s, seconds[-1], RARE_S)]
