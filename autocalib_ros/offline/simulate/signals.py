"""Traffic signals with fixed phases; left-turn phases are skipped without demand."""

from __future__ import annotations

from collections.abc import Collection

AMBER_S = 3.0
"""Duration of amber after each green phase."""
ALL_RED_S = 1.0
"""Clearance time with all signals red before the next green phase."""


class SignalController:
    """Signal controller of one junction; without phases all signals stay green."""

    def __init__(self, phases: tuple[tuple[str, float], ...], start_s: float) -> None:
        self._phases = phases
        self._index = 0
        self._start_s = start_s
        self._now = start_s
        self.green_phases: list[tuple[str, float, float]] = []
        self._log()

    def update(self, now: float, waiting: Collection[str | None]) -> None:
        """Advance to a time; waiting: names of the signals with waiting vehicles."""
        self._now = now
        if not self._phases:
            return
        if now >= self._start_s + self._phases[self._index][1] + AMBER_S + ALL_RED_S:
            self._start_s = now
            self._index = (self._index + 1) % len(self._phases)
            name = self._phases[self._index][0]
            if name.startswith('left') and name not in waiting:
                self._index = (self._index + 1) % len(self._phases)
            self._log()

    def light(self, name: str) -> str:
        """Return the state of a signal: 'green', 'amber' or 'red'."""
        phase, green_s = self._phases[self._index]
        if phase != name:
            return 'red'
        elapsed = self._now - self._start_s
        return 'green' if elapsed < green_s else 'amber' if elapsed < green_s + AMBER_S else 'red'

    def _log(self) -> None:
        if self._phases:
            name, green_s = self._phases[self._index]
            self.green_phases.append((name, self._start_s, self._start_s + green_s))
