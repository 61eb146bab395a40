"""Which lines are worth logging: nothing is repeated that has not changed, but once an hour. Needs no ROS."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import dataclass

FIRST_REPEAT_S, LAST_REPEAT_S = 60.0, 3600.0
"""Real seconds after which a line is repeated for the first time, doubled at each repeat, and at most: someone who
looks at the log finds it within the last hour."""
NUMBER = re.compile(r'\d+(\.\d+)?')


@dataclass
class _Logged:
    """What was logged of a topic: when, its words, and when it may come again."""

    at_s: float
    words: str
    repeat_s: float


class LogThrottle:
    """Remembers what was logged by topic; `clock` returns real seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._logged: dict[str, _Logged] = {}

    def is_due(self, topic: str, text: str, changed_s: float = FIRST_REPEAT_S) -> bool:
        """Whether to log a line now, which then counts as logged.

        A line whose words changed is due `changed_s` after the last one of its topic; its numbers do not count. The
        same words are due after one minute, two, four and so on, up to an hour.
        """
        now, words, before = self._clock(), NUMBER.sub('#', text), self._logged.get(topic)
        if before is None:
            self._logged[topic] = _Logged(now, words, FIRST_REPEAT_S)
            return True
        changed = words != before.words
        if now - before.at_s < (changed_s if changed else before.repeat_s):
            return False
        repeat_s = FIRST_REPEAT_S if changed else min(2 * before.repeat_s, LAST_REPEAT_S)
        self._logged[topic] = _Logged(now, words, repeat_s)
        return True

    def forget(self, prefix: str = '') -> None:
        """Let lines of the topics that begin so come at once again: what they told is over."""
        self._logged = {topic: logged for topic, logged in self._logged.items() if not topic.startswith(prefix)}
