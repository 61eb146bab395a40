"""Content of /diagnostics as a pure function of the state of the node. Needs no ROS."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum

from autocalib_ros.calibrator import CalibrationProgress
from autocalib_ros.perception.frame_clock import ClockSummary
from autocalib_ros.perception.view_watch import ViewCondition, ViewReport
from autocalib_ros.results.calibration import Calibration, StandardDeviations
from autocalib_ros.results.camera_move import CameraMove
from autocalib_ros.results.verification_table import summarise_verification
from autocalib_ros.ros.log_text import tilt_deg
from autocalib_ros.ros.solver_activity import SolverState, SolverSummary
from autocalib_ros.ros.view_events import clock_text
from autocalib_ros.ros.watchdog import NoImageDiagnosis

OK, WARN, ERROR = 0, 1, 2
"""Levels of diagnostic_msgs/DiagnosticStatus; STALE is set by the aggregator."""
RATE_WINDOW_S = 5.0
"""Real seconds over which rates are averaged."""
MAX_DROPPED_FRACTION = 0.1
"""Fraction of the received images above which dropping is reported: the machine is too slow for the camera."""


class NodeState(str, Enum):
    """State of the node."""

    WAITING_FOR_IMAGES = 'WAITING_FOR_IMAGES'
    COLLECTING = 'COLLECTING'
    RESTORED = 'RESTORED'
    MENDED = 'MENDED'
    CALIBRATED = 'CALIBRATED'
    DEGRADED = 'DEGRADED'
    MOVED = 'MOVED'
    BLIND = 'BLIND'
    RECOVERED = 'RECOVERED'


LEVELS = {
    NodeState.WAITING_FOR_IMAGES: WARN,
    NodeState.COLLECTING: WARN,
    NodeState.RESTORED: WARN,
    NodeState.MENDED: WARN,
    NodeState.CALIBRATED: OK,
    NodeState.DEGRADED: WARN,
    NodeState.MOVED: ERROR,
    NodeState.BLIND: ERROR,
    NodeState.RECOVERED: OK,
}


@dataclass(frozen=True)
class Counts:
    """Number of images by outcome, in total or per second."""

    received: float = 0
    used: float = 0
    dropped: float = 0
    unreadable: float = 0
    late: float = 0
    odd_size: float = 0
    """Of another size than the ones before, which did not last."""
    repeated: float = 0
    """Of the used ones, repeats of an earlier image."""
    lost: float = 0
    """Lost by the middleware."""


class RateCounter:
    """Image rates over the last `RATE_WINDOW_S`."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, Counts]] = deque()

    def rates_hz(self, now_s: float, counts: Counts) -> Counts | None:
        """Append the counts at a time; return them per second, None at the first call."""
        self._seen.append((now_s, counts))
        while now_s - self._seen[0][0] > RATE_WINDOW_S and len(self._seen) > 2:
            self._seen.popleft()
        since_s, before = self._seen[0]
        if now_s <= since_s:
            return None
        return Counts(
            *(
                (getattr(counts, name) - getattr(before, name)) / (now_s - since_s)
                for name in Counts.__dataclass_fields__
            )
        )


@dataclass(frozen=True, kw_only=True)
class Situation:
    """State of the node at one moment."""

    topic: str
    counts: Counts
    rates_hz: Counts | None = None
    result: Calibration | None = None
    """The published calibration."""
    restored: bool = False
    """The calibration was stored by an earlier run and is not yet verified by traffic."""
    solver: SolverSummary = field(default_factory=SolverSummary)
    mended: bool = False
    """The pose was turned by what the picture shows and is not yet verified by traffic."""
    view: ViewReport = field(default_factory=ViewReport)
    """What the newest image says about the view of the calibration."""
    withheld: bool = False
    """The calibration is not published for now."""
    valid_since_ns: int = 0
    """Stamp from which the calibration holds."""
    doubt: str = ''
    """Why the newest traffic contradicts the calibration; '' if it does not."""
    last_move: CameraMove | None = None
    moved_just_now: bool = False
    """The pose was mended less than a minute ago."""
    recovered_just_now: bool = False
    progress: CalibrationProgress | None = None
    clock: ClockSummary = field(default_factory=ClockSummary)
    """What the frame clock made of the stamps."""
    image_age_s: float | None = None
    encoding: str = ''
    no_image: NoImageDiagnosis | None = None
    unreadable: str = ''
    """Why the newest image cannot be used."""
    errors: tuple[str, ...] = ()
    """Other faults that keep the node from working."""
    warnings: tuple[str, ...] = ()
    """Other faults that the node can work with."""


@dataclass(frozen=True)
class Status:
    """Content of a diagnostic_msgs/DiagnosticStatus."""

    level: int
    message: str
    values: tuple[tuple[str, str], ...]


def state_of(situation: Situation) -> NodeState:
    """Return the state of the node."""
    unverified = situation.withheld and situation.view.condition is ViewCondition.UNKNOWN
    if situation.view.condition is ViewCondition.BLIND or unverified:
        return NodeState.BLIND
    if situation.result is not None:
        if situation.view.condition is ViewCondition.MOVED:
            return NodeState.MOVED
        if situation.recovered_just_now:
            return NodeState.RECOVERED
        if situation.moved_just_now:
            return NodeState.MOVED
        if situation.doubt:
            return NodeState.DEGRADED
        if situation.mended:
            return NodeState.MENDED
        return NodeState.RESTORED if situation.restored else NodeState.CALIBRATED
    return NodeState.COLLECTING if situation.counts.used else NodeState.WAITING_FOR_IMAGES


def status(situation: Situation) -> Status:
    """Return level, one-line message and values; the message names the gravest problems first."""
    state, problems = state_of(situation), sorted(_problems(situation), key=lambda problem: -problem[0])
    level = max([_level(state, situation), *(level for level, _ in problems)])
    message = '; '.join([_headline(state, situation), *(text for _, text in problems)])
    return Status(level, message, tuple(_values(state, situation)))


def calibration_status(situation: Situation) -> Status:
    """Return level, message and values of `~/status`: what a program has to know before it uses the calibration."""
    state, result, view, move = state_of(situation), situation.result, situation.view, situation.last_move
    ends_s = view.since_s if view.condition in (ViewCondition.MOVED, ViewCondition.BLIND) else None
    sigma = StandardDeviations() if result is None else result.stddev
    values = (
        ('state', state.value),
        ('grade', '' if result is None else result.grade),
        ('pose', _pose_word(situation)),
        ('valid_since_s', '' if result is None else f'{situation.valid_since_ns * 1e-9:.3f}'),
        ('valid_until_s', '' if result is None else _number(ends_s, '.3f')),
        ('focal_sigma_px', _number(sigma.focal_px, '.3g')),
        ('tilt_sigma_deg', _number(sigma.tilt_deg, '.3g')),
        ('roll_sigma_deg', _number(sigma.roll_deg, '.3g')),
        ('height_sigma_m', _number(sigma.height_m, '.3g')),
        *_move_values(move),
        ('fault', '' if view.fault is None else view.fault.value),
    )
    return Status(_level(state, situation), _headline(state, situation), values)


def _pose_word(situation: Situation) -> str:
    """Return what is published: '', 'calibrated', 'mended', 'withheld', or 'stale' if it is published nevertheless."""
    if situation.result is None:
        return ''
    if situation.withheld:
        return 'withheld'
    if situation.view.condition in (ViewCondition.MOVED, ViewCondition.BLIND):
        return 'stale'
    return 'mended' if situation.mended else 'calibrated'


def _move_values(move: CameraMove | None) -> Iterator[tuple[str, str]]:
    """Yield the newest move of the camera, '' without one."""
    measured = move is not None and move.is_measured
    yield 'moved_s', '' if move is None else f'{move.time_s:.3f}'
    yield 'move', '' if move is None else move.kind.value
    for name in ('pan_deg', 'tilt_deg', 'roll_deg'):
        yield f'moved_{name}', f'{getattr(move, name):.3f}' if measured else ''
    yield 'zoom', f'{move.zoom:.4f}' if move is not None and measured else ''


def _level(state: NodeState, situation: Situation) -> int:
    """Return the level of a state; a restored calibration is good once the picture shows its view."""
    verified = situation.view.condition.is_seen
    return OK if state is NodeState.RESTORED and verified else LEVELS[state]


def _headline(state: NodeState, situation: Situation) -> str:
    result, progress, view = situation.result, situation.progress, situation.view
    if state is NodeState.BLIND and view.fault is None:
        return f'{state.value}: the picture is back; the view is not verified yet'
    if state is NodeState.BLIND:
        return f'{state.value}: the picture says nothing since {clock_text(view.since_s)}: {view}'
    if state is NodeState.MOVED and situation.last_move is not None:
        return f'{state.value}: the camera moved at {clock_text(situation.last_move.time_s)}: {_move_text(situation)}'
    if result is not None:
        verified = view.condition.is_seen
        note = {
            NodeState.RESTORED: ', view verified by the picture, not yet by traffic'
            if verified
            else ', not yet verified by traffic',
            NodeState.DEGRADED: f'; {situation.doubt}',
            NodeState.MENDED: ', pose mended by what the picture shows, not yet verified by traffic',
        }.get(state, '')
        return f'{state.value}: grade {result.grade}, focal length {result.camera.focal_px:.1f} px{note}'
    if state is NodeState.COLLECTING and progress is not None:
        solving = f'; {situation.solver}' if situation.solver.state is SolverState.SOLVING else ''
        return f'{state.value}: {progress}{solving}'
    return f'{state.value}: {situation.topic}' if state is NodeState.WAITING_FOR_IMAGES else state.value


def _move_text(situation: Situation) -> str:
    """Return how the camera moved, and what is published since."""
    turning = situation.view.condition is ViewCondition.MOVED
    text = str(situation.view) if turning else str(situation.last_move)
    published = {
        'mended': 'the pose is mended by what the picture shows',
        'withheld': 'the calibration is withheld',
        'stale': 'the stale calibration is published',
    }
    return f'{text}; {published.get(_pose_word(situation), "")}'.rstrip('; ')


def _problems(situation: Situation) -> Iterator[tuple[int, str]]:
    yield from ((ERROR, text) for text in situation.errors)
    if situation.unreadable:
        yield ERROR, f'images cannot be used: {situation.unreadable}'
    if situation.no_image is not None:
        yield ERROR if situation.no_image.persistent else WARN, situation.no_image.text
    yield from ((WARN, text) for text in situation.warnings)
    if situation.solver.fault:
        yield WARN, f'{situation.solver.state.value}: {situation.solver.fault}'
    rates = situation.rates_hz
    if rates is not None and rates.dropped > MAX_DROPPED_FRACTION * rates.received:
        yield (
            WARN,
            (
                f'{rates.dropped:.1f} of {rates.received:.1f} images per second are dropped: reduce the image rate or '
                'size, max_image_width or tracking.max_points'
            ),
        )
    if rates is not None and rates.received > 0 and rates.late >= rates.received:
        yield WARN, 'the time stamps of the images do not increase, so no image is used'


def _values(state: NodeState, situation: Situation) -> Iterator[tuple[str, str]]:
    counts, rates, progress = situation.counts, situation.rates_hz, situation.progress
    yield 'state', state.value
    yield 'evidence_percent', '0' if progress is None else f'{progress.percent:.0f}'
    yield 'missing', '' if progress is None else '; '.join(progress.missing)
    yield 'outlook', '' if progress is None else progress.outlook
    yield 'image_topic', situation.topic
    yield 'encoding', situation.encoding
    yield 'image_age_s', _number(situation.image_age_s, '.1f')
    yield 'received_hz', _number(None if rates is None else rates.received, '.1f')
    yield 'used_hz', _number(None if rates is None else rates.used, '.1f')
    for name in Counts.__dataclass_fields__:
        yield name, f'{getattr(counts, name):.0f}'
    yield from _clock_values(situation.clock)
    solver = situation.solver
    yield 'solver', solver.state.value
    yield 'solving_s', _number(solver.solving_s, '.0f')
    yield 'usual_solve_s', _number(solver.usual_s, '.1f')
    yield 'solver_fault', solver.fault
    yield 'result_age_s', _number(solver.result_age_s, '.0f')
    yield 'view', situation.view.condition.value
    yield 'view_checked_s', _number(situation.view.checked_s or None, '.3f')
    yield 'sway_deg', _number(situation.view.sway_deg or None, '.3f')
    yield from _move_values(situation.last_move)
    yield 'pose', _pose_word(situation)
    yield from _result_values(situation.result)


def _clock_values(clock: ClockSummary) -> Iterator[tuple[str, str]]:
    """Yield what the frame clock made of the stamps."""
    yield 'frame_period_s', _number(clock.period_s, '.5f')
    yield 'stamp_jitter_s', _number(clock.jitter_s, '.5f')
    yield 'missing_frames', str(clock.lost)
    yield 'queued', str(clock.queued)
    yield 'odd_stamps', str(clock.odd)
    yield 'clock_steps', str(clock.steps)


def _result_values(result: Calibration | None) -> Iterator[tuple[str, str]]:
    """Yield the values of the published calibration, '' without one."""
    ground = None if result is None else result.ground
    refusal = None if result is None else result.ground_refusal
    sigma = StandardDeviations() if result is None else result.stddev
    yield 'grade', '' if result is None else result.grade
    yield 'focal_px', _number(None if result is None else result.camera.focal_px, '.2f')
    yield 'focal_sigma_px', _number(sigma.focal_px, '.3g')
    yield 'tilt_deg', _number(None if ground is None else tilt_deg(ground), '.2f')
    yield 'tilt_sigma_deg', _number(sigma.tilt_deg, '.3g')
    yield 'roll_sigma_deg', _number(sigma.roll_deg, '.3g')
    yield 'height_m', _number(ground.height_m if ground is not None and ground.metric else None, '.3f')
    yield 'height_sigma_m', _number(sigma.height_m, '.3g')
    yield 'assumptions', '' if result is None else '; '.join(map(str, result.assumptions))
    yield 'verification', '' if result is None else summarise_verification(result.verification)
    yield 'no_ground_plane', '' if refusal is None else refusal.message
    yield 'newest_stamp_s', _number(None if result is None else result.newest_stamp_ns * 1e-9, '.3f')


def _number(value: float | None, form: str) -> str:
    return '' if value is None else format(value, form)
