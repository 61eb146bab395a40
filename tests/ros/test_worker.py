"""The two threads between the image callback and the calibration."""

import threading
from concurrent.futures import Future
from dataclasses import replace

import cv2
import numpy as np
import pytest
from drawn_pictures import noisy

from autocalib_ros.config import Options
from autocalib_ros.errors import InputError
from autocalib_ros.evidence.stillness import ViewChangeKind
from autocalib_ros.lens.camera import Camera
from autocalib_ros.perception.view_watch import KnownView, ViewCondition
from autocalib_ros.ros.worker import IMAGE_QUEUE_SIZE, CalibrationWorker
from bench import PATIENCE_S, PIXELS, SIZE, calibration, refusal, wait_for

FRAME_NS = 66_000_000
NEVER_S = 1e6


class Heard:
    """A listener that records what it receives."""

    def __init__(self):
        self.sizes, self.unreadable, self.results, self.faults, self.anew = [], [], [], [], []
        self.reports, self.mend, self.moved = [], None, []

    def image_accepted(self, width, height):
        self.sizes.append((width, height))

    def on_evidence_reset(self, why, stamp_ns):
        self.anew.append(why)

    def image_unreadable(self, error):
        self.unreadable.append(str(error))

    def solved(self, result):
        self.results.append(result)

    def failed(self, error):
        self.faults.append(error)

    def picture_moved(self, change, view, stamp_ns):
        self.moved.append((change, view))

    def view_changed(self, report, stamp_ns):
        self.reports.append(report)
        return self.mend if report.move is not None and report.move.keeps_lens else None


class Slow:
    """A solver that runs until it is released."""

    def __init__(self):
        self.running, self.release = threading.Event(), threading.Event()

    def __call__(self, evidence):
        self.running.set()
        self.release.wait(PATIENCE_S)
        return calibration(evidence)


def decode(message) -> np.ndarray:
    if message is None:
        raise InputError('torn image')
    return message


@pytest.fixture
def heard() -> Heard:
    return Heard()


@pytest.fixture
def start(heard):
    """Start a worker around a solver; closed at the end."""
    started = []

    def make(solve, idle_solve_s: float = NEVER_S, **more) -> CalibrationWorker:
        """`solve` takes the evidence, and the lens too where one is given."""

        def adapted(evidence, options, *, lens):
            return solve(evidence) if lens is None else solve(evidence, lens)

        started.append(
            CalibrationWorker(
                Options(), idle_solve_s=idle_solve_s, decode=decode, solve=adapted, listener=heard, **more
            )
        )
        return started[-1]

    yield make
    for worker in started:
        worker.close(PATIENCE_S)


def feed(worker: CalibrationWorker, heard: Heard, count: int, first: int = 0) -> None:
    """Offer images one by one, each after the one before has been used."""
    for number in range(first, first + count):
        worker.offer(number * FRAME_NS, PIXELS)
        wait_for(lambda wanted=number + 1: len(heard.sizes) >= wanted, f'image {number}')


def offer_while_held_up(worker: CalibrationWorker, count: int) -> None:
    """Offer `count` images, all but the first while the first one is being decoded."""
    entered, release = threading.Event(), threading.Event()
    worker._decode = lambda message: (entered.set(), release.wait(PATIENCE_S), message)[2]
    worker.offer(0, PIXELS)
    assert entered.wait(PATIENCE_S)
    for number in range(1, count):
        worker.offer(number * FRAME_NS, PIXELS)
    release.set()


def result_of(future: Future):
    return future.result(timeout=PATIENCE_S)


def test_what_is_left_is_solved_once_when_no_image_comes(start, heard):
    worker = start(calibration, idle_solve_s=0.1)
    feed(worker, heard, 3)
    wait_for(lambda: heard.results and heard.results[-1].evidence.frames == 3, 'the idle solution')
    solved = len(heard.results)
    assert not threading.Event().wait(0.5)  # five times the idle time: long enough for a second solution to show
    assert len(heard.results) == solved


def test_images_keep_flowing_while_a_solution_runs(start, heard):
    slow = Slow()
    worker = start(slow)
    feed(worker, heard, 2)
    answer = worker.solve_now()
    assert slow.running.wait(PATIENCE_S)
    feed(worker, heard, 20, first=2)
    assert not answer.done()
    slow.release.set()
    assert result_of(answer).evidence.frames == 2


def test_newest_snapshot_takes_the_place_and_the_callers_of_one_that_waits(start, heard):
    slow = Slow()
    worker = start(slow)
    feed(worker, heard, 1)
    answers = [worker.solve_now()]
    assert slow.running.wait(PATIENCE_S)
    for number in (1, 2):
        feed(worker, heard, 1, first=number)
        answers.append(worker.solve_now())
        wait_for(lambda: not worker._requests, 'the snapshot')
    slow.release.set()
    assert [result_of(answer).evidence.frames for answer in answers] == [1, 3, 3]
    assert [result.evidence.frames for result in heard.results] == [1, 3]


def test_late_images_are_dropped_and_counted(start, heard):
    worker = start(calibration)
    offer_while_held_up(worker, IMAGE_QUEUE_SIZE + 4)
    wait_for(lambda: worker.counters.used == IMAGE_QUEUE_SIZE + 1, 'the first and the newest images')
    assert (worker.counters.received, worker.counters.dropped) == (IMAGE_QUEUE_SIZE + 4, 3)


def test_a_hiccup_loses_no_image(start, heard):
    worker = start(calibration)
    offer_while_held_up(worker, IMAGE_QUEUE_SIZE + 1)
    wait_for(lambda: worker.counters.used == IMAGE_QUEUE_SIZE + 1, 'all images')
    assert worker.counters.dropped == 0


def test_unreadable_image_is_reported_and_the_stream_goes_on(start, heard):
    worker = start(calibration)
    worker.offer(0, None)
    wait_for(lambda: heard.unreadable == ['torn image'], 'the complaint')
    feed(worker, heard, 1)
    assert (worker.counters.unreadable, worker.counters.used) == (1, 1)


def test_late_images_are_counted_and_not_used(start, heard):
    worker = start(calibration)
    feed(worker, heard, 10)
    for number in (9, 5):  # a stamp twice, and one out of order
        worker.offer(number * FRAME_NS, PIXELS)
    feed(worker, heard, 1, first=10)
    assert (worker.counters.late, worker.counters.used, heard.anew) == (2, 11, [])
    assert result_of(worker.solve_now()).evidence.frames == 11


def test_recording_that_begins_again_is_reported_and_its_evidence_restarts_the_evidence(start, heard):
    worker = start(calibration)
    feed(worker, heard, 20)
    worker.offer(0, PIXELS)
    worker.offer(100_000_000, PIXELS)  # the second tells a recording that begins again from one odd stamp
    wait_for(lambda: heard.anew, 'the news')
    assert heard.anew == ['the time stamps jumped']
    assert result_of(worker.solve_now()).evidence.frames == 2


def test_other_options_are_solved_with_though_no_image_comes(start, heard):
    heights = []
    worker = start(calibration, idle_solve_s=0.1)
    worker._solve = lambda evidence, options, lens: heights.append(options.camera_height) or calibration(evidence)
    feed(worker, heard, 1)
    wait_for(lambda: heights == [0.0], 'the first solution')
    worker.change(Options(camera_height=9.0), 0.1)
    wait_for(lambda: heights == [0.0, 9.0], 'a solution by the new options')


def test_solver_rests_unless_somebody_waits(start, heard, monkeypatch):
    monkeypatch.setattr('autocalib_ros.ros.worker.REST_FACTOR', 1e6)
    worker = start(lambda evidence: threading.Event().wait(0.01) or calibration(evidence))
    feed(worker, heard, 1)
    assert result_of(worker.solve_now())
    feed(worker, heard, 1, first=1)
    worker._submit(worker._calibrator.snapshot(), [])
    assert not threading.Event().wait(0.3)  # long enough for a solution that does not wait to show
    assert len(heard.results) == 1
    assert result_of(worker.solve_now()).evidence.frames == 2


def test_close_stops_a_solver_that_can_be_stopped_and_reports_no_fault(start, heard):
    running, stopped = threading.Event(), threading.Event()

    def slow(evidence):
        running.set()
        assert stopped.wait(PATIENCE_S)
        raise RuntimeError('stopped')

    worker = start(slow, stop_solving=stopped.set)
    feed(worker, heard, 1)
    worker.solve_now()
    assert running.wait(PATIENCE_S)
    assert worker.close(PATIENCE_S)
    assert not heard.faults


def test_fault_of_a_solver_is_reported_and_the_next_solution_works(start, heard):
    faults = [ZeroDivisionError('a bug')]

    def faulty(evidence):
        if faults:
            raise faults.pop()
        return refusal(evidence)

    worker = start(faulty)
    feed(worker, heard, 1)
    assert result_of(worker.solve_now()) is None
    assert isinstance(heard.faults[0], ZeroDivisionError)
    assert result_of(worker.solve_now()).code == 'too_few_tracks'


def test_known_lens_is_given_to_the_solver_in_the_size_of_the_images(start, heard):
    height, width = PIXELS.shape
    lens = replace(Camera.equidistant(2 * width, 2 * height, 500.0), k=(0.01, 0.0, 0.0, 0.0))
    worker = start(lambda evidence, lens: replace(calibration(evidence), camera=lens), lens=lens)
    feed(worker, heard, 1)
    camera = result_of(worker.solve_now()).camera
    assert camera == replace(Camera.equidistant(width, height, 250.0), k=(0.01, 0.0, 0.0, 0.0))


def test_image_of_another_shape_than_the_known_lens_is_left_out_and_reported(start, heard):
    height, width = PIXELS.shape
    worker = start(lambda evidence, lens: calibration(evidence), lens=Camera.equidistant(width, height, 250.0))
    worker.offer(0, np.zeros((height, 2 * width), np.uint8))
    wait_for(lambda: heard.unreadable, 'the complaint')
    assert heard.unreadable == [
        f'the lens was calibrated in images of {width}x{height}, and these images have '
        f'{2 * width}x{height}, another shape: give a calibration of their size'
    ]
    feed(worker, heard, 1)
    assert (heard.sizes, heard.faults) == ([(width, height)], [])


def test_progress_gives_the_reason_the_last_solution_was_refused(start, heard, monkeypatch):
    monkeypatch.setattr('autocalib_ros.ros.worker.PROGRESS_PERIOD_S', 0.0)
    worker = start(refusal)
    worker.offer(0, PIXELS)
    worker.solve_now().result(PATIENCE_S)
    worker.offer(FRAME_NS, PIXELS)
    wait_for(lambda: worker.progress and '12 tracks of the 40 needed.' in worker.progress.missing, 'the reason')
    assert worker.progress.percent <= 99.0


def test_nothing_to_solve_before_the_first_image(start):
    assert result_of(start(calibration).solve_now()) is None


def test_close_sends_callers_away_and_says_that_a_solution_still_runs(start, heard):
    slow = Slow()
    worker = start(slow)
    feed(worker, heard, 1)
    answer = worker.solve_now()
    assert slow.running.wait(PATIENCE_S)
    assert not worker.close(timeout_s=0.1)
    assert result_of(answer) is None
    slow.release.set()
    assert worker.close(PATIENCE_S)


def test_close_ends_idle_threads(start):
    assert start(calibration).close(PATIENCE_S)


def test_reset_drops_the_evidence(start, heard):
    worker = start(calibration)
    feed(worker, heard, 5)
    worker.reset()
    assert result_of(worker.solve_now()) is None
    feed(worker, heard, 2, first=5)
    assert result_of(worker.solve_now()).evidence.frames == 2


def test_solution_that_runs_during_a_reset_is_not_reported_and_its_callers_do_not_wait(start, heard):
    slow = Slow()
    worker = start(slow)
    feed(worker, heard, 3)
    answer = worker.solve_now()
    assert slow.running.wait(PATIENCE_S)
    worker.reset()
    assert result_of(answer) is None
    feed(worker, heard, 1, first=3)
    slow.release.set()
    assert result_of(worker.solve_now()).evidence.frames == 1
    assert [result.evidence.frames for result in heard.results] == [1]


def test_image_that_is_looked_at_during_a_reset_is_no_evidence_after_it(start, heard):
    worker = start(calibration, idle_solve_s=0.1)
    entered, release = threading.Event(), threading.Event()
    worker._decode = lambda message: (entered.set(), release.wait(PATIENCE_S), message)[2]
    worker.offer(0, PIXELS)
    assert entered.wait(PATIENCE_S)
    worker.offer(FRAME_NS, PIXELS)
    worker.reset()
    release.set()
    wait_for(lambda: heard.sizes, 'the image')
    assert result_of(worker.solve_now()) is None
    feed(worker, heard, 1, first=1)
    assert result_of(worker.solve_now()).evidence.frames == 1
    assert [result.evidence.frames for result in heard.results] == [1]


def test_reset_returns_when_nothing_is_reported_any_more(start, heard, monkeypatch):
    telling, release = threading.Event(), threading.Event()
    monkeypatch.setattr(
        heard, 'solved', lambda result: (telling.set(), release.wait(PATIENCE_S), heard.results.append(result))
    )
    worker = start(calibration)
    feed(worker, heard, 1)
    worker.solve_now()
    assert telling.wait(PATIENCE_S)
    resetting = threading.Thread(target=worker.reset)
    resetting.start()
    assert not threading.Event().wait(0.1) and resetting.is_alive()
    release.set()
    resetting.join(PATIENCE_S)
    assert len(heard.results) == 1


def test_progress_of_before_a_reset_is_forgotten(start, heard, monkeypatch):
    monkeypatch.setattr('autocalib_ros.ros.worker.PROGRESS_PERIOD_S', 0.0)
    worker = start(refusal)
    feed(worker, heard, 1)
    result_of(worker.solve_now())
    wait_for(lambda: worker.progress, 'the progress')
    worker.reset()
    assert worker.progress is None
    feed(worker, heard, 1, first=1)
    wait_for(lambda: worker.progress, 'the progress')
    assert '12 tracks of the 40 needed.' not in worker.progress.missing


def test_move_is_told_mended_and_begins_other_evidence(start, heard):
    """A view of 320x240 that moves 6 px to the right: 1.1 degrees with this lens."""
    generator = np.random.default_rng(0)
    road = np.full((SIZE[1], SIZE[0] + 6), 90.0, np.float32)
    for _ in range(120):
        x, y = generator.integers(0, (SIZE[0] - 30, SIZE[1] - 20))
        road[y : y + generator.integers(4, 20), x : x + generator.integers(6, 40)] += generator.uniform(-50, 50)
    road = cv2.GaussianBlur(np.clip(road, 0, 255), (0, 0), 0.8)
    before, after = road[:, :-6], road[:, 6:]
    worker = start(calibration)
    step_ns = 1_300_000_000

    def show(picture, first: int, count: int) -> None:
        for number in range(first, first + count):
            worker.offer(number * step_ns, noisy(np.ascontiguousarray(picture), 2.0, number))
            wait_for(lambda wanted=number + 1: len(heard.sizes) >= wanted, f'image {number}')

    show(before, 0, 12)
    result = result_of(worker.solve_now())
    worker.watch_stored(result, [KnownView(before.astype(np.uint8))])
    show(before, 12, 4)
    assert heard.reports[-1].condition is ViewCondition.STILL
    heard.mend = result
    show(after, 16, 16)
    assert not heard.faults
    move = next(report.move for report in heard.reports if report.move is not None and report.move.is_measured)
    assert move.pan_deg == pytest.approx(np.degrees(6 / 300.0), abs=0.1)
    assert worker.view.condition in (ViewCondition.STILL, ViewCondition.SWAYING)
    assert worker.known[0] is result
    assert worker._calibrator.snapshot().first_stamp_ns >= 15 * step_ns


def test_a_move_before_the_first_calibration_is_told_in_image_terms(start, heard):
    """No lens measures it, and evidence of both views is never mixed."""
    road = cv2.GaussianBlur(np.random.default_rng(1).uniform(0, 255, (180, 320)), (0, 0), 2.0)
    road = cv2.normalize(road, None, 40, 200, cv2.NORM_MINMAX).astype(np.uint8)
    noise = np.random.default_rng(3).integers(0, 9, (2, 180, 320)).astype(np.uint8)
    worker = start(calibration)
    for number in range(70):
        picture = road if number < 30 else np.roll(road, (4, 7), axis=(0, 1))
        worker.offer(number * 10**9, cv2.add(picture, noise[number % 2]))
        wait_for(lambda wanted=number + 1: len(heard.sizes) >= wanted, f'image {number}')
    ((change, view),) = heard.moved
    assert (change.kind, view) == (ViewChangeKind.TURN, 1)
    assert change.displacement_px == pytest.approx(np.hypot(4, 7), abs=0.5)
    assert result_of(worker.solve_now()).evidence.frames < 45
