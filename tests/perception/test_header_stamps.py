"""Choice between the stamp of an image and its time of receipt."""

import numpy as np
import pytest

from autocalib_ros.perception.header_stamps import HeaderStamps

SECOND = 10**9
START = 1_700_000_000 * SECOND
RECEIPTS = START + np.arange(90) * SECOND // 15 + 3 * SECOND // 100
"""15 Hz, received 30 ms after the exposures."""
EXPOSURES = RECEIPTS - 3 * SECOND // 100


def chosen(given: np.ndarray, receipts: np.ndarray = RECEIPTS) -> tuple[np.ndarray, list[str]]:
    """Return the stamps chosen for those given, and the warnings."""
    warnings: list[str] = []
    stamps = HeaderStamps(warnings.append)
    return np.array(
        [
            stamps.choose(*divmod(stamp, SECOND), receipt)
            for stamp, receipt in zip(given.tolist(), receipts.tolist(), strict=True)
        ]
    ), warnings


def test_good_stamps_are_kept_without_a_warning():
    stamps, warnings = chosen(EXPOSURES)
    assert (stamps == EXPOSURES).all() and not warnings


def test_images_without_stamps_get_their_times_of_receipt():
    stamps, warnings = chosen(0 * EXPOSURES)
    assert (stamps == RECEIPTS).all() and len(warnings) == 1


def test_one_image_without_a_stamp_gets_its_time_of_receipt_by_the_clock_of_the_others():
    given = EXPOSURES - 3600 * SECOND  # a camera whose clock is an hour late
    given[40] = 0
    stamps, warnings = chosen(given)
    assert stamps[40] == EXPOSURES[40] - 3600 * SECOND and len(warnings) == 1


@pytest.mark.parametrize('first', range(15))
def test_whole_seconds_lose_no_image_whenever_the_second_changes(first):
    stamps, warnings = chosen((EXPOSURES + first * SECOND // 15) // SECOND * SECOND)
    assert (np.diff(stamps) > 0).all() and len(warnings) == 1
    assert np.diff(stamps[32:]) == pytest.approx(SECOND / 15, abs=2)


def test_a_clock_that_stood_still_and_goes_again_is_used_again():
    given = EXPOSURES.copy()
    given[20:40] = given[20]
    stamps, warnings = chosen(given)
    assert (stamps[:21] == EXPOSURES[:21]).all() and (stamps[65:] == EXPOSURES[65:]).all()
    assert stamps[24:65] == pytest.approx(EXPOSURES[24:65], abs=SECOND // 100)
    assert len(warnings) == 1


def test_stamps_that_come_twice_are_kept():
    given = np.concatenate([EXPOSURES[:10], np.repeat(EXPOSURES[10:50], 2)])
    stamps, warnings = chosen(given)
    assert (stamps == given).all() and not warnings


def test_nanoseconds_in_32_bits_are_put_right():
    warnings: list[str] = []
    stamps = HeaderStamps(warnings.append)
    times = EXPOSURES.tolist()
    found = [stamps.choose(time // SECOND, time % 2**32, time) for time in times]
    first = next(index for index, time in enumerate(times) if time % 2**32 >= SECOND)
    assert found[first:] == times[first:] and len(warnings) == 1


def test_the_second_stamp_tells_whether_time_begins_at_zero():
    simulated = HeaderStamps(lambda _: None, second_ns=SECOND // 15)
    assert simulated.choose(0, 0, START) == 0
    missing = HeaderStamps(lambda _: None, second_ns=0)
    assert missing.choose(0, 0, START) == START
