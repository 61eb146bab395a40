"""When a new solution is due: by time, by tracks, and by what an accepted one can gain."""

from types import SimpleNamespace

from autocalib_ros.config import GateOptions, Options
from autocalib_ros.evidence.solution_schedule import SolutionSchedule
from autocalib_ros.evidence.still_parts import StillPart

OPTIONS = Options(
    camera_height=8.0, first_solve_s=10.0, solve_interval_s=5.0, solve_growth=1.2, gate=GateOptions(min_tracks=40)
)


def part_of(tracks: int, seen: int | None = None, start_s: float = 0.0) -> StillPart:
    """Return a part that holds so many tracks, of those it has seen."""
    return StillPart(SimpleNamespace(track_count=tracks), start_s, tracks_seen=tracks if seen is None else seen)


def grown(part: StillPart, tracks: int, seen: int) -> StillPart:
    part.buffer.track_count, part.tracks_seen = tracks, seen
    return part


def test_the_first_solution_waits_for_time_and_tracks() -> None:
    schedule = SolutionSchedule(OPTIONS)
    assert not schedule.is_due(part_of(100), 9.9)
    assert not schedule.is_due(part_of(39), 60.0)
    assert schedule.is_due(part_of(40), 10.0)


def test_the_next_solution_waits_for_a_pause_and_more_tracks() -> None:
    schedule, part = SolutionSchedule(OPTIONS), part_of(100)
    assert schedule.is_due(part, 20.0)
    assert not schedule.is_due(grown(part, 200, 200), 24.9)
    assert not schedule.is_due(grown(part, 119, 119), 25.0)
    assert schedule.is_due(grown(part, 120, 120), 25.0)


def test_another_view_of_the_camera_begins_anew() -> None:
    schedule = SolutionSchedule(OPTIONS)
    assert schedule.is_due(part_of(100), 20.0)
    other = part_of(100, start_s=20.5)
    assert not schedule.is_due(other, 30.0)
    assert schedule.is_due(other, 30.5)


def test_an_accepted_calibration_is_solved_again_when_that_can_be_better() -> None:
    schedule, part = SolutionSchedule(OPTIONS), part_of(1000)
    assert schedule.is_due(part, 20.0)
    schedule.accepted(part, 1000)
    assert not schedule.is_due(grown(part, 1380, 1380), 60.0)  # 15 % need 1384 tracks
    assert schedule.is_due(grown(part, 1385, 1385), 60.0)
    schedule.accepted(part, 1385)
    # a full buffer does not grow; it is due once all of it is newer
    assert not schedule.is_due(grown(part, 1385, 2 * 1385 - 1), 90.0)
    assert schedule.is_due(grown(part, 1385, 2 * 1385), 90.0)
