"""A line that has not changed comes a few times in the first hour, and once an hour then."""

from autocalib_ros.ros.log_throttle import EVENTS_S, FIRST_REPEAT_S, LAST_REPEAT_S, MAX_EVENTS, LogThrottle


class Watch:
    """A clock that is set."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


def lines_in(hours: float, text_at, every_s: float = 10.0) -> list[float]:
    """Return when a line is logged that is offered at regular times."""
    clock = Watch()
    throttle = LogThrottle(clock)
    logged = []
    for step in range(round(hours * 3600 / every_s)):
        clock.now = 1000.0 + step * every_s
        if throttle.is_due('topic', text_at(step)):
            logged.append(step * every_s)
    return logged


def test_the_same_words_come_less_and_less():
    logged = lines_in(24, lambda step: f'no image for {step} s')  # the number alone is no change
    assert logged[:4] == [0, FIRST_REPEAT_S, 3 * FIRST_REPEAT_S, 7 * FIRST_REPEAT_S]
    assert len([at for at in logged if at < 3600]) <= 6
    assert logged[-1] - logged[-2] == LAST_REPEAT_S and len(logged) < 24 + 6


def test_other_words_come_after_a_minute_at_the_earliest():
    assert lines_in(0.1, lambda step: f'state {"ab"[step % 2]}')[:3] == [0, 60, 130]
    assert lines_in(0.02, lambda step: 'first' if step < 3 else 'second') == [0, 60]


def test_a_changed_reason_may_come_at_once():
    clock = Watch()
    throttle = LogThrottle(clock)
    assert throttle.is_due('no image', 'no publisher') and throttle.is_due('no image', 'wrong type', changed_s=0.0)
    assert not throttle.is_due('no image', 'wrong type', changed_s=0.0)


def test_topics_do_not_know_each_other_and_can_be_forgotten():
    throttle = LogThrottle(Watch())
    assert throttle.is_due('refusal a', 'text') and throttle.is_due('fault', 'text')
    throttle.forget('refusal')
    assert throttle.is_due('refusal a', 'text') and not throttle.is_due('fault', 'text')


def test_events_are_told_each_until_there_are_too_many_and_those_left_out_are_counted():
    clock = Watch()
    throttle = LogThrottle(clock)
    told = []
    for second in range(0, 2 * round(EVENTS_S), 60):
        clock.now = 1000.0 + second
        told.append(throttle.event('frozen'))
    assert told[:MAX_EVENTS] == [''] * MAX_EVENTS and told[MAX_EVENTS] is None
    left_out = round(EVENTS_S) // 60 - MAX_EVENTS
    assert [text for text in told if text] == [f' ({left_out} more like this were not logged)']
    assert len([text for text in told if text is not None]) == 2 * MAX_EVENTS
    assert throttle.event('black') == ''


def test_words_that_go_to_and_fro_are_some_lines_an_hour():
    logged = lines_in(24, lambda step: f'state {"ab"[step // 9 % 2]}')  # every 90 s
    assert len(logged) <= 24 * (MAX_EVENTS + 2)
