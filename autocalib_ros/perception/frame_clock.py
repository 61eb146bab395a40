"""Frame clock: times of exposure of a stream of images from their stamps, which may be times of receipt.

A regular grid with lost images is fitted through the stamps, see `frame_grid`. An image whose stamp is that of the next
slot passes at once. Any other is held until a later one tells what it is:

- later ones follow where the grid expects them after it: images were lost before it, or the stream paused;
- they catch up with the grid: it and those that follow at once had waited in a queue;
- they are where the grid expects them without it: its stamp is odd, or the image came twice or late;
- they continue from its stamp: the clock was set while the images go on, or a recording starts again.

Without a grid (the first images, intervals without a period) the stamps are the times. Everything depends on the stamps
and their order alone, but for two questions that they leave open: whether images were lost or the clock was set
forward, and whether an image came late or the clock was set back by a frame. Traffic that moved by one step from image
to image tells, where there is any: images follow at the period whatever the clock does.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from autocalib_ros.perception.frame_grid import (
    CERTAIN_SIGMA,
    MAX_IMAGES,
    MAX_SIGMA,
    QUEUED,
    SLOTS_PER_IMAGE,
    FrameGrid,
    find_grid,
    fit_grid,
    wanders,
)

MAX_PAUSE_NS = 24 * 3600 * 1_000_000_000
"""No camera pauses for longer than a day: a longer step forward means that the clock was set."""
MAX_CLOCK_STEP_NS = 1000 * 1_000_000_000
"""A running clock is set back by less than this: NTP gives up at 1000 s, TAI and UTC are 37 s apart. A longer step back
is another recording."""
START_NS = 1_000_000_000
"""A step back to within this of the first stamp is a recording that starts again: some of its first images are lost."""
WRAP_NS = 2**32
"""Nanoseconds in 32 bits start again after this."""
GAP_NS = 1_000_000_000
"""After a pause of this length the phase of the grid is taken from the next image: a camera that was stopped starts
at another, and no track spans it."""
GAP_INTERVALS_RAW = 10.0
"""Without a grid, a longer step than this many median intervals (and than `GAP_NS`) waits for the next image to tell a
pause from an odd stamp."""
EVEN_FRAMES = 0.02
"""A stamp within this of its slot, in frames, is the time of exposure to the digit: a vehicle that moves 10 px a frame
moves 0.2 px in it, less than its points are located to."""
UNEVEN = 0.05
"""Jitter, frames, from which on stamps are called uneven: a whole millisecond at 60 Hz leaves 2 %."""
LEAST_STEP = 0.25
"""Least time between two images, frames, where a grid found anew lies before times already given."""
MAX_HELD = 16
"""Most images held while a burst lasts: half a second at 30 Hz."""
CHECKED, MISFITS, MANY_LEFT_OUT = 12, 8, 3
"""Images after which the grid is judged: it is left if two thirds did not fit, if a quarter had to be left out though
their stamps increase, or if each came after lost ones. So a rate that halves or doubles is followed within a second.
"""
FEW_LOST, LEAST_SIGMA_LOST = 0.1, 0.25
"""A grid in which more than this share of the slots is empty has to be sharper than this, in frames: the more slots are
empty, the nearer any times lie to one."""
SURE_SIGMA = 0.08
"""Frames: if half of the last `PHASE_RUN` errors exceed three times this and three standard deviations, the rate has
changed."""
SEARCH_IMAGES = 8
"""Images between two searches for a grid where the last `MAX_IMAGES` show none: a search takes milliseconds."""
REFIT = 8
"""Images between two fits while the stamps are even."""
PHASE_RUN, PHASE_SHIFT = 8, 0.1
"""Images in a row on one side of the grid by this (frames, and three standard deviations) after which the phase is
taken from them alone."""


@dataclass(frozen=True)
class ClockSummary:
    """What the frame clock saw so far."""

    period_s: float | None = None
    """Frame period, seconds; None without a regular grid."""
    jitter_s: float | None = None
    """Robust standard deviation of the stamps from the grid, seconds."""
    images: int = 0
    """Images that got a time."""
    lost: int = 0
    """Slots of the grid without an image."""
    queued: int = 0
    """Images that another followed within half a period: doublets and bursts."""
    odd: int = 0
    """Images whose stamp was wrong, which got the time of their slot."""
    left_out: int = 0
    """Images left out: late, sent twice, or of a stamp that nothing explains."""
    steps: int = 0
    """Steps of the clock while the images went on."""

    @property
    def is_uneven(self) -> bool:
        """Whether the stamps were not those of a camera that exposes regularly and loses nothing."""
        jitter = (self.jitter_s or 0.0) > UNEVEN * (self.period_s or 1.0)
        return jitter or any((self.lost, self.queued, self.odd, self.left_out, self.steps))

    def __str__(self) -> str:
        """Return the summary as one line, with what did not happen left out."""
        rate = (
            'no regular frame period'
            if self.period_s is None
            else f'frame period {1e3 * self.period_s:.2f} ms, jitter {1e3 * (self.jitter_s or 0.0):.1f} ms'
        )
        counts = (
            (self.lost, 'lost'),
            (self.queued, 'queued (doublets, bursts)'),
            (self.odd, 'with an odd stamp'),
            (self.left_out, 'late or twice, left out'),
            (self.steps, 'steps of the clock'),
        )
        return ', '.join([rate, f'images: {self.images} timed', *(f'{n} {what}' for n, what in counts if n)])


@dataclass(frozen=True)
class TimedImage:
    """An image that has its time."""

    image: int
    """Number of the image in order of arrival, from 0."""
    time_ns: int
    """Time of exposure on a clock that is never set: that of the stamps, less all steps so far."""
    lost: int = 0
    """Slots of the grid without an image before it; 0 without a grid, and after a pause."""


@dataclass(frozen=True)
class ClockReading:
    """What became of the images with a new stamp."""

    timed: tuple[TimedImage, ...] = ()
    """Images that got their time now, in order of time."""
    restarted: bool = False
    """A recording starts again, or the clock was set far: `timed` begins a new time."""
    is_late: bool = False
    """The image of this stamp is left out, unless later ones show that the clock was set back."""


@dataclass(frozen=True)
class _Arrival:
    image: int
    stamp_ns: int


class FrameClock:
    """Clock of one stream of images. Deterministic and causal: an image is held for a few others at most.

    `follows` tells whether a held image, by its number, shows the traffic one step after the last image that got its
    time in an earlier call; False where nothing tells.
    """

    def __init__(self, follows: Callable[[int], bool] = lambda image: False) -> None:
        self._follows = follows
        self._arrived = 0
        self._summary = ClockSummary()
        self._begin()

    def _begin(self) -> None:
        """Forget everything but the counts."""
        self.offset_ns = 0
        """What all steps of the clock add up to: time plus offset is the time by the present clock."""
        self._first_ns: int | None = None
        self._newest_ns = self._previous_ns = 0
        self._time_ns: int | None = None
        self._held: list[_Arrival] = []
        self._raw: deque[int] = deque(maxlen=MAX_IMAGES)
        self._distrusted = False
        self._leave_grid()

    def _leave_grid(self) -> None:
        self._grid: FrameGrid | None = None
        self._lost_by_grid = 0
        self._unbroken = 0
        """Images in a row, each in the slot after that of the one before, since the clock was set."""
        self._unsearched = 0
        self._slot = 0
        self._window: deque[tuple[int, int, bool]] = deque(maxlen=MAX_IMAGES)
        self._misfits: deque[bool] = deque(maxlen=CHECKED)
        self._advances: deque[int] = deque(maxlen=CHECKED)
        self._errors: deque[float] = deque(maxlen=PHASE_RUN)
        self._surplus: deque[bool] = deque(maxlen=CHECKED)

    def _abandon_grid(self) -> None:
        """Look for another grid, in later images: those so far are of the old one.

        The slots that its last images left empty were none: they are why it is left.
        """
        self._count(lost=len(self._advances) - sum(self._advances))
        held, self._held = self._held, []
        self._leave_grid()
        self._distrusted = True
        self._raw.clear()
        self._raw.append(self._newest_ns)
        self._accept_all(held)

    @property
    def held(self) -> frozenset[int]:
        """Numbers of the images that wait for their time."""
        return frozenset(arrival.image for arrival in self._held)

    def summary(self) -> ClockSummary:
        """Return what the clock saw so far."""
        if self._grid is None:
            return self._summary
        period_s = self._grid.period_ns * 1e-9
        return replace(self._summary, period_s=period_s, jitter_s=self._grid.sigma * period_s)

    def add(self, stamp_ns: int) -> ClockReading:
        """Take the stamp of the next image; return the images that have their time now."""
        self._timed: list[TimedImage] = []
        self._restarted = False
        number, late = self._arrived, self._first_ns is not None and stamp_ns <= self._newest_ns
        self._arrived += 1
        self._accept(_Arrival(number, int(stamp_ns)))
        timed_now = any(timed.image == number for timed in self._timed)
        is_late = not timed_now and (late or number not in self.held)
        return ClockReading(tuple(self._timed), self._restarted, is_late)

    # what happens to one image

    def _accept(self, arrival: _Arrival) -> None:
        if self._first_ns is None:
            self._first_ns = arrival.stamp_ns
            self._emit(arrival, arrival.stamp_ns)
        elif self._held:
            self._held.append(arrival)
            if self._grid is None:
                self._resolve_raw()
            else:
                self._resolve(self._grid)
        elif self._grid is None:
            self._accept_raw(arrival)
        else:
            self._accept_on_grid(arrival, self._grid)

    def _accept_all(self, arrivals: Sequence[_Arrival]) -> None:
        for arrival in arrivals:
            self._accept(arrival)

    def _accept_on_grid(self, arrival: _Arrival, grid: FrameGrid) -> None:
        frames = grid.frames_from(self._slot + 1, arrival.stamp_ns)
        if abs(frames) <= QUEUED:
            self._take_slot(arrival, self._slot + 1)
        elif arrival.stamp_ns == self._newest_ns and frames < 0:
            self._leave_out()
        else:
            self._held = [arrival]

    def _resolve(self, grid: FrameGrid) -> None:
        """Decide on the first held image by the newest one, with a grid."""
        head, newest, count = self._held[0], self._held[-1], len(self._held) - 1
        first = grid.frames_from(self._slot + 1, head.stamp_ns)
        frames = grid.frames_from(self._slot + 1, newest.stamp_ns)
        surplus = frames - count  # 0: as many images as slots
        if count > 1 and grid.sigma >= CERTAIN_SIGMA:
            surplus = (surplus + grid.frames_from(self._slot + count, self._held[-2].stamp_ns)) / 2
        waited = 0 <= newest.stamp_ns - self._held[-2].stamp_ns < QUEUED * grid.period_ns
        if abs(surplus) <= QUEUED:
            self._take_consecutive()
        elif waited and count < MAX_HELD:
            return  # a burst: its end tells
        elif surplus > 0 and newest.stamp_ns >= head.stamp_ns and first > 0:
            self._confirm_loss(grid, first)
        elif surplus > 0 or (first > 0 and frames < -QUEUED):
            self._take_head()  # there is room for it, and its stamp is odd
        elif first > 0 and (grid.sigma < CERTAIN_SIGMA or first > 1 + QUEUED):
            self._overtaken(grid, frames)
        elif first > 0:
            self._take_consecutive()  # jitter, rather than images that overtake each other
        elif count < 2 and grid.sigma >= CERTAIN_SIGMA and frames > -2 * QUEUED:
            return  # the jitter may explain it
        elif self._continues(head, newest, grid.period_ns) and (frames < -QUEUED or self._goes_on(head)):
            self._step(head, newest, grid.time_ns(self._slot + 1))
        else:
            self._drop_head()

    def _goes_on(self, head: _Arrival) -> bool:
        """Return whether the traffic shows that no image is missing before the first held one.

        Asked only where stamps are even and more images than a burst holds came since one was lost, or the clock set:
        where images are lost all the time, one more is no reason to doubt the clock, and the even stamps within bursts
        are those of the network.
        """
        even = self._grid is None or (self._grid.sigma < CERTAIN_SIGMA and self._unbroken >= MAX_HELD)
        return even and not self._timed and self._follows(head.image)

    def _confirm_loss(self, grid: FrameGrid, first: float) -> None:
        """Images were lost before the first held one, if enough later ones agree; or the clock was set forward."""
        later = [grid.frames_from(self._slot + 1, arrival.stamp_ns) - index for index, arrival in enumerate(self._held)]
        head, rest, lost = self._held[0], self._held[1:], max(round(min(later)), 0)
        if first * grid.period_ns >= MAX_PAUSE_NS or (lost and self._goes_on(head)):
            self._step(head, self._held[-1], grid.time_ns(self._slot + 1))
        elif first * grid.period_ns >= GAP_NS:
            self._held = []
            self._pause(head, grid)
            self._accept_all(rest)
        elif len(rest) > 1 or grid.sigma < CERTAIN_SIGMA:
            self._held = []
            self._take_slot(head, self._slot + 1 + lost)
            self._accept_all(rest)

    def _take_consecutive(self) -> None:
        held, self._held = self._held, []
        for arrival, following in zip(held, [*held[1:], None], strict=True):
            self._take_slot(arrival, self._slot + 1, following)

    def _take_head(self) -> None:
        head, rest = self._held[0], self._held[1:]
        self._held = []
        self._take_slot(head, self._slot + 1)
        self._accept_all(rest)

    def _drop_head(self) -> None:
        head, rest, self._held = self._held[0], self._held[1:], []
        self._leave_out(misfit=head.stamp_ns > self._newest_ns)
        self._accept_all(rest)

    def _overtaken(self, grid: FrameGrid, frames: float) -> None:
        """The newest has a stamp before that of the first held one: it takes the slot before it, or is late."""
        newest = self._held.pop()
        if abs(frames) <= QUEUED and len(self._held) == 1:
            rest, self._held = self._held, []
            self._take_slot(newest, self._slot + 1)
            self._accept_all(rest)
        else:
            self._leave_out(misfit=True)

    def _pause(self, arrival: _Arrival, grid: FrameGrid) -> None:
        """Go on after a pause: period and slots as before, the phase from the next image."""
        slot = self._slot + 1 + max(round(grid.frames_from(self._slot + 1, arrival.stamp_ns)), 0)
        self._grid = grid.shifted(arrival.stamp_ns - grid.time_ns(slot))
        self._window.clear()
        self._errors.clear()
        self._slot = slot - 1
        self._take_slot(arrival, slot)

    # without a grid

    def _accept_raw(self, arrival: _Arrival) -> None:
        step = arrival.stamp_ns - self._newest_ns
        if 0 < step < self._longest_raw_step():
            self._emit(arrival, arrival.stamp_ns)
        elif step == 0:
            self._leave_out()
        else:
            self._held = [arrival]

    def _longest_raw_step(self) -> float:
        """Return the step from which on a stamp without a grid is odd, or follows a pause."""
        if len(self._raw) < 3:
            return GAP_NS if len(self._raw) == 1 else MAX_PAUSE_NS
        return max(GAP_NS, GAP_INTERVALS_RAW * float(np.median(np.diff(self._raw))))

    def _resolve_raw(self) -> None:
        """Decide on the held image by the next one, without a grid."""
        head, newest = self._held
        if len(self._raw) == 1:
            self._resolve_second(head, newest)
            return
        step, longest = head.stamp_ns - self._newest_ns, self._longest_raw_step()
        follows_newest = 0 < newest.stamp_ns - self._newest_ns < longest
        follows_head = 0 < newest.stamp_ns - head.stamp_ns < longest
        if follows_head and 0 < step < MAX_PAUSE_NS and not self._goes_on(head):
            self._held = []
            self._raw.clear()
            self._emit(head, head.stamp_ns)
            self._accept(newest)
        elif follows_head and not follows_newest:
            interval = float(np.median(np.diff(self._raw))) if len(self._raw) > 1 else newest.stamp_ns - head.stamp_ns
            self._step(head, newest, self._newest_ns + round(interval))
        else:
            self._held = []
            self._leave_out()
            self._accept(newest)

    def _resolve_second(self, head: _Arrival, newest: _Arrival) -> None:
        """Decide by the third image whether the second is odd, or the first, or the rate slow."""
        step, following = head.stamp_ns - self._newest_ns, newest.stamp_ns - head.stamp_ns
        held, self._held = self._held, []
        if following > 0 and not 0 < step < GAP_INTERVALS_RAW * following:
            self._begin_anew(held)  # the first is odd
        elif following > 0:
            self._emit(head, head.stamp_ns)
            self._accept(newest)
        else:
            self._leave_out()
            self._accept(newest)

    # what follows from it

    @staticmethod
    def _continues(head: _Arrival, newest: _Arrival, period_ns: float) -> bool:
        """Return whether the newest follows the head as regularly as images do."""
        frames = (newest.stamp_ns - head.stamp_ns) / period_ns
        return QUEUED < frames < 4.0

    def _step(self, head: _Arrival, newest: _Arrival, expected_ns: int) -> None:
        """The clock was set: go on with the images, or begin anew if it must be another recording."""
        by_ns = head.stamp_ns - expected_ns
        held, self._held = self._held, []
        assert self._first_ns is not None
        tolerance_ns = 2 * abs(newest.stamp_ns - head.stamp_ns)
        wrapped = abs(by_ns + WRAP_NS) < tolerance_ns
        starts_again = by_ns < 0 and abs(head.stamp_ns - self._first_ns) < START_NS
        if not wrapped and (by_ns >= MAX_PAUSE_NS or by_ns <= -MAX_CLOCK_STEP_NS or starts_again):
            self._begin_anew(held)
            return
        if wrapped:
            by_ns = -WRAP_NS
        self.offset_ns += by_ns
        self._first_ns += by_ns
        self._newest_ns += by_ns
        self._previous_ns += by_ns
        self._raw = deque((stamp_ns + by_ns for stamp_ns in self._raw), maxlen=MAX_IMAGES)
        if self._grid is not None:
            self._grid = self._grid.shifted(by_ns)
            self._window = deque(((slot, s + by_ns, counts) for slot, s, counts in self._window), maxlen=MAX_IMAGES)
        self._count(steps=1)
        self._unbroken = 0
        self._accept_all(held)

    def _begin_anew(self, arrivals: Sequence[_Arrival]) -> None:
        self._begin()
        self._restarted = True
        self._accept(arrivals[0])
        for arrival in arrivals[1:]:  # they follow it, or it would not have been believed
            if arrival.stamp_ns > self._newest_ns:
                self._emit(arrival, arrival.stamp_ns)
            else:
                self._accept(arrival)

    def _take_slot(self, arrival: _Arrival, slot: int, following: _Arrival | None = None) -> None:
        """Give an image the time of its slot, and fit the grid again; `following` is the next one if known."""
        grid = self._grid
        if grid is None:  # left while the images of a burst were taken
            self._accept(arrival)
            return
        error = grid.frames_from(slot, arrival.stamp_ns)
        fits = abs(error) <= 1.0
        after_queued = 0 <= arrival.stamp_ns - self._previous_ns < QUEUED * grid.period_ns
        waited = following is not None and 0 <= following.stamp_ns - arrival.stamp_ns < QUEUED * grid.period_ns
        if after_queued and self._window:
            self._window[-1] = (*self._window[-1][:2], False)
        explained = fits or waited or after_queued
        lost = slot - self._slot - 1
        self._lost_by_grid += lost
        self._count(lost=lost, queued=int(after_queued), odd=int(not explained))
        self._advances.append(slot - self._slot)
        self._unbroken = 0 if lost else self._unbroken + 1
        self._surplus.append(False)
        self._slot = slot
        self._window.append((slot, arrival.stamp_ns, fits and not waited))
        if fits and not waited and not (after_queued and abs(error) > QUEUED):
            self._errors.append(error)
        self._misfits.append(abs(error) > QUEUED and not waited and not after_queued)
        self._emit(arrival, arrival.stamp_ns if abs(error) <= EVEN_FRAMES else grid.time_ns(slot), fits, lost)
        self._fit(grid)

    def _fit(self, grid: FrameGrid) -> None:
        if self._slot % REFIT and self._is_even(grid):
            return
        if self._has_moved(grid):
            keep = list(self._window)[-PHASE_RUN + 1 :]
            self._window = deque(keep, maxlen=MAX_IMAGES)
            self._errors.clear()
        slots, stamps, counts = zip(*self._window, strict=True)
        fitted = fit_grid(grid, np.array(slots), np.array(stamps, np.int64), np.array(counts, bool))
        images, span = len(slots), slots[-1] - slots[0] + 1
        if not fitted.period_ns > 0 or span > SLOTS_PER_IMAGE['most'] * images:
            self._count(lost=-self._lost_by_grid)
            self._leave_grid()  # it was found within a burst, so its slots were none
        elif (
            self._rate_changed(grid)
            or self._misfit()
            or wanders(fitted, images)
            or fitted.sigma > (MAX_SIGMA + CERTAIN_SIGMA if images > (1 - FEW_LOST) * span else LEAST_SIGMA_LOST)
        ):
            self._abandon_grid()
        else:
            self._grid = fitted
            self._distrusted &= images < MAX_IMAGES

    def _is_even(self, grid: FrameGrid) -> bool:
        """Return whether the last images came one a slot and at its time."""
        run = list(self._errors)
        return (
            len(run) == PHASE_RUN
            and max(abs(error) for error in run) <= EVEN_FRAMES
            and grid.sigma <= EVEN_FRAMES
            and max(self._advances) == 1
        )

    def _rate_changed(self, grid: FrameGrid) -> bool:
        if len(self._advances) == CHECKED and min(self._advances) > 1:
            return True
        errors = np.abs(self._errors)
        return len(errors) == PHASE_RUN and bool(np.median(errors) > 3 * max(SURE_SIGMA, grid.sigma))

    def _has_moved(self, grid: FrameGrid) -> bool:
        errors = np.array(self._errors)
        if len(errors) < PHASE_RUN or not ((errors > 0).all() or (errors < 0).all()):
            return False
        return bool(np.median(np.abs(errors)) > max(PHASE_SHIFT, 3 * grid.sigma))

    def _misfit(self) -> bool:
        return sum(self._misfits) >= MISFITS or sum(self._surplus) >= MANY_LEFT_OUT

    def _emit(self, arrival: _Arrival, clock_ns: int, fits: bool = True, lost: int = 0) -> None:
        """Give an image its time; look for a grid if there is none."""
        time_ns = clock_ns - self.offset_ns
        if self._time_ns is not None:
            least = 1 if self._grid is None else round(LEAST_STEP * self._grid.period_ns)
            time_ns = max(time_ns, self._time_ns + least)
        self._time_ns = time_ns
        self._newest_ns = arrival.stamp_ns if fits else clock_ns
        self._previous_ns = arrival.stamp_ns
        self._timed.append(TimedImage(arrival.image, time_ns, lost))
        self._count(images=1)
        if fits:
            self._raw.append(arrival.stamp_ns)
        if self._grid is None:
            self._look_for_grid()

    def _look_for_grid(self) -> None:
        self._unsearched += 1
        if len(self._raw) == MAX_IMAGES and self._unsearched < SEARCH_IMAGES:
            return
        self._unsearched = 0
        stamps = np.array(self._raw, np.int64)
        found = find_grid(stamps, exact=self._distrusted)
        if found is None:
            return
        self._leave_grid()
        self._grid = found
        steps = np.diff(stamps)
        waited = np.append(steps < QUEUED * found.period_ns, False)
        for stamp_ns, in_queue in zip(self._raw, waited.tolist(), strict=True):
            slot = round(found.frames_from(0, stamp_ns))
            near = abs(found.frames_from(slot, stamp_ns)) < QUEUED / 2
            self._window.append((slot, stamp_ns, near and not in_queue))
        # after the last image that had not waited, one slot for each: the newest may be the first of a burst
        fresh = int(np.flatnonzero(~waited[:-1])[-1])
        self._slot = self._window[fresh][0] + len(steps) - fresh

    def _leave_out(self, misfit: bool = False) -> None:
        self._count(left_out=1)
        if misfit:
            self._misfits.append(True)
            self._surplus.append(True)
            if self._misfit():
                self._abandon_grid()

    def _count(self, **more: int) -> None:
        self._summary = replace(
            self._summary, **{name: getattr(self._summary, name) + number for name, number in more.items()}
        )
