"""Stamps of image headers as drivers really send them: chooses, for each image, its stamp or its time of receipt."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

SECOND_IN_NS = 1_000_000_000
WRAP_32_BITS = 2**32
"""A count of nanoseconds in 32 bits starts again after this."""
RECENT_IMAGES = 30
"""Images over which repeated stamps are counted: one to two seconds, so that whole seconds are told from a driver that
repeats a few."""
REPEATS_IN_A_ROW = 4
"""Repeated stamps in a row after which the clock stands still or is too coarse: no driver sends an image five times.
One is enough at the beginning, before the clock was seen to go.
"""
GOOD_SHARE = 2 / 3
"""Share of the recent images with a new stamp above which the stamps are used again: at two images a second, a clock of
whole seconds reaches a half."""


class HeaderStamps:
    """Chooses the stamps of one stream, the same live and in a replay; `warn` gets one line for each kind of fault.

    The time of receipt (live) or of recording (replay) is shifted to the clock of the stamps as far as they tell it, so
    that a change between the two is no jump.
    """

    def __init__(self, warn: Callable[[str], None], second_ns: int | None = None) -> None:
        """`second_ns` is the stamp of the second image if it is known already, as in a recording."""
        self._warn, self._second_ns = warn, second_ns
        self._warned: set[str] = set()
        self._previous_ns: int | None = None
        self._repeats_in_a_row = 0
        self._repeated: deque[bool] = deque(maxlen=RECENT_IMAGES)
        self._offsets_ns: deque[int] = deque(maxlen=RECENT_IMAGES)
        self._by_receipt = self._wrapped = False

    def choose(self, seconds: int, nanoseconds: int, receipt_ns: int) -> int:
        """Return the stamp of the next image in nanoseconds, from its header and its time of receipt.

        An image without a stamp (zero) gets its time of receipt, unless the second shows that time begins at zero.
        """
        given_ns = self._unwrapped(seconds, nanoseconds)
        previous_ns = self._previous_ns
        if previous_ns is None and self._second_ns is not None:
            given_previous = self._second_ns == given_ns  # then the first image is judged by the second
            missing, previous_ns = given_ns == 0 and given_previous, given_ns if given_previous else None
        else:
            missing = given_ns == 0
        self._previous_ns = given_ns
        if missing:
            self._warn_once('images have no time stamp: using the time of receipt')
            return self._receipt(receipt_ns)
        self._note(given_ns, previous_ns, receipt_ns)
        return self._receipt(receipt_ns) if self._by_receipt else given_ns

    def _note(self, given_ns: int, previous_ns: int | None, receipt_ns: int) -> None:
        """Count repeated stamps, and decide whether they can be used."""
        repeated = given_ns == previous_ns
        self._repeats_in_a_row = self._repeats_in_a_row + 1 if repeated else 0
        self._repeated.append(repeated)
        if not repeated:
            # the least delay tells the difference of the two clocks; the first of a stamp that repeats is the nearest
            self._offsets_ns.append(given_ns - receipt_ns)
        if self._repeats_in_a_row >= (REPEATS_IN_A_ROW if len(self._offsets_ns) > 1 else 1):
            self._by_receipt = True
            self._warn_once(
                'images in a row have the same time stamp, because its clock stands still or '
                'counts whole seconds: using the time of receipt until it goes on'
            )
        elif self._repeated.count(False) > GOOD_SHARE * RECENT_IMAGES:
            self._by_receipt = False

    def _receipt(self, receipt_ns: int) -> int:
        """Return the time of receipt by the clock of the stamps; as it is if that clock never went."""
        return receipt_ns + (max(self._offsets_ns) if len(self._offsets_ns) > 1 else 0)

    def _unwrapped(self, seconds: int, nanoseconds: int) -> int:
        """Return a stamp in nanoseconds; repair one whose nanoseconds are those of the whole time in 32 bits."""
        given_ns = seconds * SECOND_IN_NS + nanoseconds
        if nanoseconds >= SECOND_IN_NS:
            self._wrapped = True
            self._warn_once(
                'the nanoseconds of the time stamps exceed a second: taken for those of the whole time in 32 bits, and '
                'put right'
            )
        if not self._wrapped:
            return given_ns
        begin_ns = seconds * SECOND_IN_NS
        whole_ns = begin_ns + (nanoseconds - begin_ns) % WRAP_32_BITS
        return whole_ns if whole_ns < begin_ns + SECOND_IN_NS else given_ns

    def _warn_once(self, text: str) -> None:
        if text not in self._warned:
            self._warned.add(text)
            self._warn(text)
