"""Which lines are worth logging: nothing is repeated that has not changed, but once an hour. Needs no ROS.

States last: their line comes again when its words change, see `LogThrottle.is_due`. Events are news each time, see
`LogThrottle.event`.
"""

from __future__ import annotations

import re
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

FIRST_REPEAT_S, LAST_REPEAT_S = 60.0, 3600.0
"""Real seconds after which a line is repeated for the first time, doubled at each repeat, and at most: someone who
looks at the log finds it within the last hour."""
MAX_EVENTS, EVENTS_S = 6, 3600.0
"""Most lines about events of one kind within this many real seconds: each is news, but a camera that freezes every
minute must not fill the log."""
NUMBER = re.compile(r'\d+(\.\d+)?')


@dataclass
class _Logged:
    """What was logged of a topic: when, its words, and when they may come again."""

    at_s: float = 0.0
    words: str | None = None
    """None where nothing was logged, or what it told is over."""
    repeat_s: float = FIRST_REPEAT_S
    news_s: deque[float] = field(default_factory=lambda: deque(maxlen=MAX_EVENTS))
    """When other words were logged."""


@dataclass
class _Events:
    """When the last events of a kind were logged, and how many were not since."""

    at_s: deque[float]
    unlogged: int = 0


class LogThrottle:
    """Remembers what was logged by topic; `clock` returns real seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._logged: dict[str, _Logged] = {}
        self._events: dict[str, _Events] = {}

    def is_due(self, topic: str, text: str, changed_s: float = FIRST_REPEAT_S) -> bool:
        """Whether to log a line now, which then counts as logged.

        A line whose words changed is due `changed_s` after the last one of its topic; its numbers do not count. The
        same words are due after one minute, two, four and so on, up to an hour. Words that change more often than
        `MAX_EVENTS` times within `EVENTS_S` count as the same.
        """
        now, words = self._clock(), NUMBER.sub('#', text)
        logged = self._logged.setdefault(topic, _Logged())
        often = len(logged.news_s) == MAX_EVENTS and now - logged.news_s[0] < EVENTS_S
        if words != logged.words and not often:
            if logged.words is not None and now - logged.at_s < changed_s:
                return False
            if not logged.news_s or now - logged.news_s[-1] >= EVENTS_S:
                logged.repeat_s = FIRST_REPEAT_S
            logged.news_s.append(now)
        elif now - logged.at_s < logged.repeat_s:
            return False
        else:
            logged.repeat_s = min(2 * logged.repeat_s, LAST_REPEAT_S)
        logged.at_s, logged.words = now, words
        return True

    def event(self, kind: str) -> str | None:
        """Take an event that is news each time: return what to add to its line, None if it is not to be logged.

        Of each kind `MAX_EVENTS` within `EVENTS_S` are logged; the next line tells how many were not.
        """
        now = self._clock()
        events = self._events.setdefault(kind, _Events(deque(maxlen=MAX_EVENTS)))
        if len(events.at_s) == MAX_EVENTS and now - events.at_s[0] < EVENTS_S:
            events.unlogged += 1
            return None
        events.at_s.append(now)
        unlogged, events.unlogged = events.unlogged, 0
        return f' ({unlogged} more like this were not logged)' if unlogged else ''

    def forget(self, prefix: str = '') -> None:
        """Let lines of the topics that begin so come at once again: what they told is over."""
        for topic, logged in self._logged.items():
            if topic.startswith(prefix):
                logged.words = None
