"""Times of exposure from stamps, judged by the true ones; errors in fractions of a frame."""

from dataclasses import dataclass

import numpy as np
import pytest

from autocalib_ros.offline.simulate.stamp_faults import STAMP_FAULTS
from autocalib_ros.perception.frame_clock import ClockSummary, FrameClock

SECOND = 10**9
START_NS = 1_700_000_000 * SECOND
FOUND_AFTER = 70
"""Images after which the grid has been found under any fault: two bursts of ten more than the 24 it takes at jitter."""
KNOWN_BY_RECEIPT = ('seconds', 'constant', 'stopped')
"""Faults that `HeaderStamps` mends with the time of receipt."""


@dataclass(frozen=True)
class Clocked:
    """What became of a stream."""

    images: np.ndarray
    """Indices among the images that arrived, of those that got a time."""
    times_ns: np.ndarray
    epochs: np.ndarray
    """Number of restarts before each."""
    summary: ClockSummary
    arrived: int


def clocked(stamps_ns: np.ndarray) -> Clocked:
    clock, times, epochs, restarts = FrameClock(), {}, {}, 0
    for stamp_ns in stamps_ns.tolist():
        reading = clock.add(stamp_ns)
        restarts += reading.restarted
        for timed in reading.timed:
            times[timed.image], epochs[timed.image] = timed.time_ns, restarts
    images = np.array(sorted(times, key=lambda image: (epochs[image], times[image])))
    return Clocked(
        images,
        np.array([times[image] for image in images]),
        np.array([epochs[image] for image in images]),
        clock.summary(),
        len(stamps_ns),
    )


def exposures(count: int = 300, rate_hz: float = 15.0, start_ns: int = START_NS) -> np.ndarray:
    return start_ns + np.round(np.arange(count) * SECOND / rate_hz).astype(np.int64)


def interval_errors(result: Clocked, true_ns: np.ndarray, period_ns: float) -> np.ndarray:
    """Return the errors of the intervals between successive images, frames, after `FOUND_AFTER` images."""
    errors = (np.diff(result.times_ns) - np.diff(true_ns[result.images])) / period_ns
    return np.abs(errors[FOUND_AFTER:])


@pytest.mark.parametrize('rate_hz', [0.5, 10.0, 25.0, 30000 / 1001])
@pytest.mark.parametrize('start_ns', [0, START_NS])
def test_even_stamps_are_the_times_to_the_digit(rate_hz, start_ns):
    stamps = exposures(150, rate_hz, start_ns)
    result = clocked(stamps)
    assert (result.times_ns == stamps).all()
    assert result.summary.period_s == pytest.approx(1 / rate_hz, rel=1e-6)
    assert str(result.summary).endswith('images: 150 timed')


# Each leaves true intervals but for one or two images at a fault that the stamps alone cannot tell from another: a
# clock set forward looks like lost images, a jitter of 30 % like a lost one once in a thousand images.
TOLERATED = {
    'ntp_forward_0.1': 2,
    'ntp_back_0.1': 2,
    'ntp_forward_1': 1,
    'utc_to_tai': 1,
    'started_again': 1,
    'unsorted_jitter_30': 4,
    'jitter_30': 2,
    'late_jitter': 4,
    'rate_halved': 3,
    'wrapped_in_seconds': 40,
}


@pytest.mark.parametrize('fault', [name for name in STAMP_FAULTS if name not in KNOWN_BY_RECEIPT])
def test_intervals_are_those_of_the_exposures(fault):
    rate_hz = 30.0
    true_ns = exposures(360, rate_hz)
    arrived = STAMP_FAULTS[fault](true_ns, np.random.default_rng(1))
    result = clocked(arrived.stamps_ns)
    errors = interval_errors(result, true_ns[arrived.images], SECOND / rate_hz)
    assert (errors > 0.25).sum() <= TOLERATED.get(fault, 0)
    # a jitter of 30 % of a frame leaves 3 % between two images: it is averaged over 64
    assert np.quantile(errors, 0.9) < 0.06
    lost = {'sent_twice': 36, 'wrapped_in_seconds': 4}.get(fault, 3)
    assert result.arrived - len(result.images) <= lost
    within = result.epochs[1:] == result.epochs[:-1]
    assert (np.diff(result.times_ns)[within] > 0).all()
    assert result.epochs[-1] == int(fault == 'started_again')


@pytest.mark.parametrize('rate_hz', [15.0, 30.0])
@pytest.mark.parametrize('fault', ['ntp_forward_0.1', 'ntp_forward_1', 'utc_to_tai', 'ntp_back_0.1'])
def test_a_clock_that_is_set_while_the_traffic_goes_on_costs_no_image_and_no_time(fault, rate_hz):
    true_ns = exposures(rate_hz=rate_hz)
    arrived = STAMP_FAULTS[fault](true_ns, np.random.default_rng(1))
    clock, times = FrameClock(lambda image: True), {}
    for stamp_ns in arrived.stamps_ns.tolist():
        times.update({timed.image: timed.time_ns for timed in clock.add(stamp_ns).timed})
    # stamps are whole nanoseconds, the period of the grid is not
    np.testing.assert_allclose([times[image] - START_NS for image in range(300)], true_ns - START_NS, rtol=0, atol=10)
    assert clock.summary().steps == 1 and clock.summary().lost == 0
    assert clock.offset_ns == pytest.approx(arrived.stamps_ns[-1] - true_ns[-1], abs=10)


@pytest.mark.parametrize('rate_hz', [15.0, 30.0, 60.0])
@pytest.mark.parametrize('count', [3, 5, 8, 10, 14])
@pytest.mark.parametrize('follows', [False, True])
def test_bursts_of_any_size_are_spread_over_their_exposures(count, rate_hz, follows):
    true_ns = exposures(600, rate_hz)
    waited_for = np.minimum(np.arange(600) // count * count + count - 1, 599)
    clock, times = FrameClock(lambda image: follows), {}
    for stamp_ns in (true_ns[waited_for] + np.arange(600) % count * 500_000).tolist():
        times.update({timed.image: timed.time_ns for timed in clock.add(stamp_ns).timed})
    intervals = np.diff([times[image] for image in range(600)]) * rate_hz / SECOND
    # a grid takes three whole bursts, and the one after them is spread from its first image on
    assert np.abs(intervals[5 * count :] - 1.0).max() < 0.1
    assert (clock.summary().steps, clock.summary().lost) == (0, 0)


def test_traffic_is_asked_only_where_images_are_not_lost_all_the_time():
    asked = []
    clock = FrameClock(lambda image: bool(asked.append(image)))
    for stamp_ns in STAMP_FAULTS['dropped_half'](exposures(600), np.random.default_rng(1)).stamps_ns.tolist():
        clock.add(stamp_ns)
    assert len(asked) <= 1  # before a grid is found


@pytest.mark.parametrize('fault', ['one_ahead_10_min', 'one_ahead_2_days', 'one_zero_in_45'])
def test_an_odd_stamp_costs_nothing(fault):
    true_ns = exposures()
    result = clocked(STAMP_FAULTS[fault](true_ns, np.random.default_rng(1)).stamps_ns)
    np.testing.assert_array_equal(result.images, np.arange(len(true_ns)))
    assert np.abs(result.times_ns - true_ns).max() < 1000  # the slot of a grid that is exact to its last digit
    assert result.summary.odd == {'one_zero_in_45': 7}.get(fault, 1)


def test_what_happened_is_told():
    true_ns = exposures(900, 30.0)
    told = {
        name: clocked(STAMP_FAULTS[name](true_ns, np.random.default_rng(1)).stamps_ns).summary
        for name in ('jitter_20', 'dropped_2', 'rare_bursts_of_10', 'sent_twice', 'tai_to_utc', 'bursts_of_10')
    }
    assert told['jitter_20'].jitter_s == pytest.approx(0.2 / 30, rel=0.4)  # of 64 images, without those that waited
    assert told['dropped_2'].lost == 2 * 6
    assert told['rare_bursts_of_10'].queued == 9 * 6 and told['rare_bursts_of_10'].odd == 0
    assert told['sent_twice'].left_out == 90
    assert told['tai_to_utc'].steps == 1
    assert told['bursts_of_10'].period_s == pytest.approx(1 / 30, rel=0.01)
    assert 'frame period 33.3' in str(told['dropped_2']) and '12 lost' in str(told['dropped_2'])


def test_each_image_knows_how_many_were_lost_before_it():
    arrived = STAMP_FAULTS['dropped_2'](exposures(900, 30.0), np.random.default_rng(1))
    clock, lost = FrameClock(), {}
    for stamp_ns in arrived.stamps_ns.tolist():
        lost.update({arrived.images[timed.image]: timed.lost for timed in clock.add(stamp_ns).timed})
    before = np.append(0, np.diff(arrived.images) - 1)
    assert sum(lost.values()) == 12
    assert {image for image, count in lost.items() if count == 2} == set(arrived.images[before == 2])


@pytest.mark.parametrize('rate_hz', [15.0, 30.0])
def test_images_that_wait_for_each_other_are_not_lost(rate_hz):
    stamps = STAMP_FAULTS['bursts_of_10'](exposures(600, rate_hz), np.random.default_rng(1)).stamps_ns
    assert clocked(stamps).summary.lost == 0  # also not by a grid that was found within the first burst


@pytest.mark.parametrize('count', [10, 21, 40])
def test_a_stream_that_begins_with_a_burst_has_lost_nothing(count):
    # decoders that read ahead give their first images at once, half a millisecond apart
    stamps = exposures(300)
    stamps[:count] = stamps[count] - SECOND // 20 - (SECOND // 2000) * np.arange(count)[::-1]
    summary = clocked(stamps).summary
    assert summary.lost == 0 and summary.period_s == pytest.approx(1 / 15, rel=1e-3)


@pytest.mark.parametrize('rates_hz', [(30.0, 15.0), (15.0, 30.0)])
def test_a_rate_that_halves_or_doubles_loses_nothing(rates_hz):
    first = exposures(200, rates_hz[0])
    stamps = np.append(first, exposures(200, rates_hz[1], int(first[-1] + SECOND / rates_hz[1])))
    assert clocked(stamps).summary.lost == 0


@pytest.mark.parametrize('spread', [0.5, 0.8])
def test_irregular_intervals_keep_their_stamps(spread):
    random = np.random.default_rng(3)
    stamps = START_NS + np.cumsum(random.uniform(1 - spread, 1 + spread, 250) * SECOND / 15).astype(np.int64)
    result = clocked(stamps)
    assert (result.times_ns == stamps[result.images]).mean() > 0.97
    assert len(result.images) >= 245


def test_intervals_that_wander_keep_their_stamps_nearly():
    intervals = (1 + 0.1 * np.sin(np.arange(450) / 24)) / 30
    stamps = START_NS + np.round(np.cumsum(intervals) * SECOND).astype(np.int64)
    result = clocked(stamps)
    errors = interval_errors(result, stamps, SECOND / 30)
    assert len(result.images) == 450 and errors.max() < 0.3 and np.quantile(errors, 0.9) < 0.1


@pytest.mark.parametrize('fault', ['jitter_20', 'dropped_half', 'rare_bursts_of_10'])
def test_a_rate_that_changes_is_followed(fault):
    true_ns = np.concatenate(
        [exposures(200, 30.0), exposures(200, 20.0) + 7 * SECOND, exposures(200, 30.0) + 17 * SECOND]
    )
    arrived = STAMP_FAULTS[fault](true_ns[200:400], np.random.default_rng(1))
    stamps = np.concatenate([true_ns[:200], arrived.stamps_ns, true_ns[400:]])
    true_ns = np.concatenate([true_ns[:200], true_ns[200:400][arrived.images], true_ns[400:]])
    result = clocked(stamps)
    wrong = np.abs(np.diff(result.times_ns) - np.diff(true_ns[result.images])) > 0.25 * SECOND / 30
    assert wrong.sum() < 45  # a second or two at each change: with jitter the grid is found in 24 images
    assert not wrong[-100:].any()
    assert result.summary.period_s == pytest.approx(1 / 30, rel=1e-3)


def test_two_consistent_stamps_at_the_beginning_are_a_recording_that_starts_again():
    clock = FrameClock()
    for stamp_ns in exposures(100).tolist():
        clock.add(stamp_ns)
    first, second, third = exposures(3).tolist()
    assert clock.add(first).is_late
    reading = clock.add(second)
    assert reading.restarted and [timed.time_ns for timed in reading.timed] == [first, second]
    assert [timed.time_ns for timed in clock.add(third).timed] == [third]


def test_an_image_is_held_for_a_burst_at_most():
    clock, held = FrameClock(), []
    arrived = STAMP_FAULTS['rare_bursts_of_10'](exposures(), np.random.default_rng(1))
    for stamp_ns in arrived.stamps_ns.tolist():
        clock.add(stamp_ns)
        held.append(len(clock.held))
    assert max(held) == 9


@pytest.mark.parametrize('first_ns', [0, START_NS - 3600 * SECOND, START_NS + 3600 * SECOND])
def test_an_odd_first_stamp_is_forgotten(first_ns):
    stamps = exposures(50)
    stamps[0] = first_ns
    result = clocked(stamps)
    np.testing.assert_array_equal(result.times_ns[result.epochs == 1], stamps[1:])


@pytest.mark.parametrize('seed', range(6))
def test_no_stamps_break_it(seed):
    random = np.random.default_rng(seed)
    stamps = exposures(400) + np.round(random.normal(0, 0.2, 400) * SECOND / 15).astype(np.int64)
    for _ in range(60):  # spans of any fault, one upon another
        first, length = random.integers(0, 400), random.integers(1, 8)
        by_ns = int(random.choice([-1, 1]) * 10 ** random.uniform(4, 15))
        span = slice(first, 400 if random.random() < 0.3 else first + length)
        kind = random.integers(4)
        if kind == 0:
            stamps[span] += by_ns
        elif kind == 1:
            stamps[span] = stamps[first]
        elif kind == 2:
            stamps[span] = 0
        else:
            stamps[span] = random.permutation(stamps[span])
    result = clocked(stamps)
    within = result.epochs[1:] == result.epochs[:-1]
    assert (np.diff(result.times_ns)[within] > 0).all()
    assert len(np.unique(result.images)) == len(result.images)
    assert len(result.images) + result.summary.left_out + 16 >= 400
