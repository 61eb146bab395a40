"""The live node: parameters, services, topics and log. The calibration itself needs no ROS."""

from __future__ import annotations

import concurrent.futures
import contextlib
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_srvs.srv import Trigger

from autocalib_ros.calibrator import AutoCalibrator
from autocalib_ros.config import NodeOptions, Options
from autocalib_ros.errors import AutocalibError, InputError
from autocalib_ros.evidence.stillness import ViewChange
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import camera_info
from autocalib_ros.lens.camera_info_yaml import read_camera_info
from autocalib_ros.perception.detector.detector import VehicleDetector, open_detector
from autocalib_ros.perception.images import ImageDecoder
from autocalib_ros.perception.view_file import read_views
from autocalib_ros.perception.view_watch import KnownView, ViewCondition, ViewReport
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.results.camera_move import CameraMove, MoveKind
from autocalib_ros.results.control_points import read_control_points
from autocalib_ros.results.given_pixels import FollowedPixels, GivenPixels
from autocalib_ros.results.history import read_history, version_entry
from autocalib_ros.results.store import Store, StoredCalibration, calibration_checksum, resolve_url
from autocalib_ros.revalidation import CalibrationState, with_current_options
from autocalib_ros.ros.declared_parameters import declare_parameters
from autocalib_ros.ros.diagnostics import Diagnostics
from autocalib_ros.ros.driver_info import DriverInfo
from autocalib_ros.ros.driver_upload import DriverUpload
from autocalib_ros.ros.headers import DEFAULT_FRAME, Headers
from autocalib_ros.ros.image_input import UNNAMED, ImageInput, node_name
from autocalib_ros.ros.live_parameters import LiveParameters
from autocalib_ros.ros.live_pictures import LivePictures
from autocalib_ros.ros.log_text import describe, describe_briefly, describe_progress
from autocalib_ros.ros.node_log import NodeLog
from autocalib_ros.ros.publication import CalibrationPublisher, Published
from autocalib_ros.ros.report_writer import ReportPaths, ReportWriter
from autocalib_ros.ros.side_files import SideFiles
from autocalib_ros.ros.status import Counts, RateCounter, Situation
from autocalib_ros.ros.store_writer import StoreWriter
from autocalib_ros.ros.view_events import ViewEvents, clock_text
from autocalib_ros.ros.worker import CalibrationWorker, CalibratorFactory, Result, Solve
from autocalib_ros.solver_process import SolverProcess

PROGRESS_LOG_PERIOD_S = 10.0
"""Real seconds between two looks at the progress for the log."""
VIEWS_PERIOD_S = 5.0
"""Real seconds between two looks for views to be stored; they change at each calibration, and with the light."""
SHUTDOWN_S = 4.0
"""Time limit of the shutdown: `ros2 launch` kills a node 5 s after the interrupt."""


class AutocalibNode(Node):
    """Node `autocalib`. `solve` replaces the solver process by a function that runs in the solver thread.

    `calibrator` makes the object that gathers the evidence.
    """

    def __init__(
        self, *, solve: Solve | None = None, calibrator: CalibratorFactory = AutoCalibrator, **node_arguments: Any
    ) -> None:
        super().__init__('autocalib', automatically_declare_parameters_from_overrides=True, **node_arguments)
        self.options, self.node_options = declare_parameters(self)
        self._lens = self._read_lens()
        points_file = self.node_options.control_points
        self._control_points = read_control_points(Path(points_file)) if points_file else None
        self._pixels = FollowedPixels(GivenPixels.of(self.options, self._control_points))
        detector = open_detector(self.options.detector)
        self._headers = Headers(
            self.node_options,
            self.get_namespace(),
            self.get_logger().warning,
            lambda: self.get_clock().now().nanoseconds,
        )
        # state of the log and of /diagnostics
        self._told = NodeLog(self.get_logger())
        self._unreadable = self._withdrawn = ''
        self._rate_counter = RateCounter()
        # destinations of an accepted calibration: disk, report, driver
        self._store = self._open_store('')
        self.store_writer = StoreWriter(
            lambda fault: self.get_logger().error(f'the calibration was not saved: {fault}')
        )
        self._side_files = SideFiles(self.store_writer)
        self._reports = ReportWriter(lambda text, good: self._told.tell(text, good=good))
        self._upload = (
            DriverUpload(self, partial(self._told.tell_outcome, 'upload'))
            if self.node_options.upload_to_driver
            else None
        )
        self._events = ViewEvents()
        self._set_aside: tuple[Published, tuple[KnownView, ...]] | None = None
        """Calibration that was withdrawn for another image size, with its views."""
        # topics
        self._driver = DriverInfo(self, self.node_options)
        self.publication = CalibrationPublisher(
            self,
            self.options,
            self.node_options,
            self._headers,
            driver=self._driver,
            control_points=self._control_points,
            pixels=self._pixels,
            on_accepted=self._on_accepted,
            on_withdrawn=self._on_withdrawn,
        )
        self._pictures = LivePictures(
            self,
            self.node_options.debug_rate_hz,
            self.publication,
            self._headers,
            ignored=self.options.ignored_polygons,
            failed=self.failed,
            progress=lambda: self._worker.progress,
        )
        self._worker = self._start_worker(solve, detector, calibrator)
        if self._store is not None:
            self._restore(self._store)
        # inputs: last, because their callbacks use all of the above
        self._create_services()
        self._input = ImageInput(self, self.node_options, self._on_image)
        self._live_parameters = LiveParameters(
            self, self.options, self.node_options, self._change, lambda: self.publication.image_size
        )
        self._diagnostics = Diagnostics(
            self, self._situation, lambda: self._headers.camera_name(self.publication.image_frame or DEFAULT_FRAME)
        )
        self.create_timer(PROGRESS_LOG_PERIOD_S, self._log_progress, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.create_timer(VIEWS_PERIOD_S, self._store_views, clock=Clock(clock_type=ClockType.STEADY_TIME))
        if detector is not None:
            self.get_logger().info(f'vehicle detector: {detector}')
        self.get_logger().info(f'waiting for images on {self._input.topic}')

    def _read_lens(self) -> Camera | None:
        """Return the lens of `camera_info_file`, None without one; UsageError if `distortion_model` does not fit it."""
        if not self.node_options.camera_info_file:
            return None
        lens = read_camera_info(self.node_options.camera_info_file)
        camera_info(lens, self.options.distortion_model)
        return lens

    def _start_worker(
        self, solve: Solve | None, detector: VehicleDetector | None, calibrator: CalibratorFactory
    ) -> CalibrationWorker:
        solver = SolverProcess(self.node_options.solve_limit_s)
        return CalibrationWorker(
            self.options,
            idle_solve_s=self.node_options.idle_solve_s,
            decode=ImageDecoder().decode,
            solve=solve or solver,
            listener=self,
            viewer=self._pictures,
            lens=self._lens,
            detector=detector,
            stop_solving=solver.close,
            calibrator=calibrator,
        )

    def _create_services(self) -> None:
        """Create the services, each in a callback group of its own: a caller that waits blocks no other callback."""
        if not self.node_options.services:
            return
        for name, callback in (
            ('~/calibrate', self._on_calibrate),
            ('~/save', self._on_save),
            ('~/reset', self._on_reset),
        ):
            self.create_service(Trigger, name, callback, callback_group=MutuallyExclusiveCallbackGroup())

    def close(self) -> None:
        """Stop the threads. Call this once, before `destroy_node`."""
        deadline = time.monotonic() + SHUTDOWN_S
        if not self.store_writer.close(SHUTDOWN_S / 2):
            self.get_logger().warning('shutdown: a calibration was still being written and is lost')
        if not self._reports.close():
            self.get_logger().warning('shutdown: a report was still being drawn and is given up; an earlier one stays')
        if not self._worker.close(deadline - time.monotonic()):
            self.get_logger().warning('shutdown: a solution was still running and is lost')
        self._pictures.close(max(0.0, deadline - time.monotonic()))
        self.get_logger().info(f'shutdown: {self._worker.counters}; time stamps: {self._worker.clock}')

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Reject parameters with a helpful reason: rclpy rejects a wrong type before any callback."""
        return self._live_parameters.refusal(parameter_list) or super().set_parameters_atomically(parameter_list)

    def _change(self, options: Options, node_options: NodeOptions) -> None:
        """Use other options: the evidence is solved again with them."""
        if options.scale != self.options.scale:
            self._pixels.given_anew(GivenPixels.of(options, self._control_points))
        self.options, self.node_options = options, node_options
        self.publication.change(options, node_options)
        self._pictures.rate_hz = node_options.debug_rate_hz
        self._worker.change(self._options_in_view(), node_options.idle_solve_s)

    def _options_in_view(self) -> Options:
        """Return the options with known lengths in pixels of the present view."""
        size = self.publication.image_size
        return self.options if size is None else self._pixels.present.options_in_view(self.options, size)

    def _follow_pixels(self) -> None:
        """Solve with the pixels of the present view, and say what became of the known lengths."""
        options = self._options_in_view()
        if options == self._worker.options:
            return
        given, left = (len(each.scale.known_distances) for each in (self.options, options))
        self._worker.change(options, self.node_options.idle_solve_s)
        if left < given:
            self.get_logger().warning(
                f'{given - left} of {given} known distances are not used any more: they are pixels of the view before '
                'the camera moved; set scale.distances to pixels of the present view'
            )

    def _follow_regions(self, move: CameraMove | None) -> None:
        """Ignore the given regions where they are in the image, and where the same places are in the present view."""
        if not self.options.ignored_polygons:
            return
        ignored = self._pixels.present.regions_in_view(self.options)
        self._worker.ignore(ignored)
        self._pictures.ignored = ignored
        if move is not None and move.kind is MoveKind.OTHER_VIEW:
            self._told.tell_event(
                'regions',
                'ignore_regions stay where they are in the image, since the turn of the camera is unknown: check that '
                'they cover private places in the present view',
            )

    def _on_image(self, message: Any) -> None:
        """Queue the image for the perception thread and publish its CameraInfo; returns within microseconds."""
        frame_id = self._headers.frame_id(message.header.frame_id)
        self._worker.offer(self._headers.stamp_ns(message.header.stamp), message)
        foreign = self.publication.on_image(message, frame_id)
        if foreign is not None and self.publication.published is None:
            self._told.tell_event(
                'frame',
                f"restored calibration withdrawn: its frame is '{foreign.image_frame}', that of the images "
                f"'{frame_id}'; still collecting evidence",
            )
        elif foreign is not None:
            self._told.tell_event(
                'frame',
                f"the frame of the images is now '{frame_id}', before '{foreign.image_frame}': the ground transform is "
                'published for the new frame; consumers of tf keep the one of before until they restart',
            )
        if self._store is None:
            self._store = store = self._open_store(frame_id)
            if store is not None:
                self.store_writer.run(partial(self._restore, store))

    async def _on_calibrate(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self._worker.counters.used:
            response.success, response.message = False, f'no image received yet on {self._input.topic}'
            return response
        result = await self._wrap_future(self._worker.solve_now())
        response.success = isinstance(result, Calibration)
        response.message = (
            'no solution: the evidence was reset meanwhile, or no image arrived since; else see the log of the node'
            if result is None
            else describe(result)
        )
        return response

    async def _on_save(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        published, state, store = self.publication.published, self.publication.state, self._store
        if published is None or store is None:
            response.success = False
            response.message = f'nothing to save, no calibration yet; {describe_progress(self._worker.progress)}'
            return response
        if self.publication.withheld:
            response.success, response.message = False, f'nothing to save: {self.publication.withheld}'
            return response
        stored = self._to_stored(published)
        error = await self._wrap_future(self.store_writer.run(lambda: store.save(stored, replace_foreign=True)))
        if error is None and self.publication.published is published:
            self.store_writer.withdraw()  # already written
        if error is None:
            self.store_writer.saved = stored
        response.success = error is None
        response.message = (
            f'not saved: {error}'
            if error
            else f'saved the {state.value} calibration to {store.path} and {store.json_path}; '
            f'the report will be written to {store.report}'
        )
        if error is None:
            self._report(published, store)
        return response

    def _report(self, published: Published, store: Store) -> None:
        """Start to write the report of a calibration; the log reports when it is done."""
        source = f'{self._headers.camera_name(published.image_frame) or "camera"}, live on {self._input.topic}'

        def write(snapshot: concurrent.futures.Future) -> None:
            scene = self._reports.scene(published.result, snapshot.result(), self._options_in_view(), source)
            with contextlib.suppress(InputError):  # a report without a history is one
                scene = replace(scene, history=tuple(read_history(store.history)))
            self._reports.write(ReportPaths(store.report, store.figures), scene)

        self._worker.request_snapshot().add_done_callback(write)

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Drop the evidence and withdraw the calibration; the stored one stays until the next is saved."""
        self._worker.reset()
        self._pictures.forget()
        was = self.publication.withdraw()
        self._set_aside = None
        self._worker.watch_nothing()
        self._reports.forget()
        response.success = True
        response.message = (
            'evidence dropped'
            + ('' if was is CalibrationState.NONE else f', {was.value} calibration withdrawn')
            + '; collecting new evidence'
        )
        self.get_logger().info(f'reset: {response.message}')
        self._told.start_over()
        return response

    def _wrap_future(self, running: concurrent.futures.Future) -> Future:
        """Return an awaitable for the result of another thread; that thread then wakes the executor."""
        executor = self.executor
        awaited = Future(executor=executor)

        def hand_over(done: concurrent.futures.Future) -> None:
            awaited.set_result(done.result())
            if executor is not None:
                executor.wake()

        running.add_done_callback(hand_over)
        return awaited

    def _situation(self) -> Situation:
        """Return the present state of the node for /diagnostics."""
        published = self.publication.published
        counts = Counts(**vars(self._worker.counters), lost=self._input.lost)
        unsaved = f'the calibration is not saved: {self.store_writer.fault}' if self.store_writer.fault else ''
        return Situation(
            topic=self._input.topic,
            counts=counts,
            rates_hz=self._rate_counter.rates_hz(time.monotonic(), counts),
            result=None if published is None else published.result,
            restored=self.publication.state is CalibrationState.RESTORED,
            solver=self._worker.solver.summary(),
            mended=self.publication.state is CalibrationState.MENDED,
            view=self._worker.view,
            withheld=bool(self.publication.withheld),
            valid_since_ns=self.publication.valid_since_ns,
            doubt=self.publication.doubt,
            last_move=self._events.last_move,
            moved_just_now=self._events.moved_just_now,
            recovered_just_now=self._events.recovered_just_now,
            progress=self._worker.progress,
            clock=self._worker.clock,
            image_age_s=self._input.age_s,
            encoding=self._input.encoding,
            no_image=self._input.no_image,
            unreadable=self._unreadable,
            errors=tuple(filter(None, [self._withdrawn, self.publication.conflict])),
            warnings=tuple(
                filter(
                    None,
                    [
                        self._other_publishers(),
                        self._driver.check(self.publication.image_size),
                        self._input.several_publishers,
                        unsaved,
                    ],
                )
            ),
        )

    def _other_publishers(self) -> str:
        """Return a warning if other nodes publish to our camera_info topic; '' if not."""
        topic = self.publication.topic
        if self.count_publishers(topic) < 2:
            return ''
        own = self.get_fully_qualified_name()
        names = {node_name(info) for info in self.get_publishers_info_by_topic(topic)} - {own}
        remedy = 'remap one of the two, here with -r ~/camera_info:=...'
        if not names:
            names, remedy = {'a second node of this name'}, 'end one of the two, or give it -r __ns:=/OTHER'
        text = f'{", ".join(sorted(names))} also publishes {topic}: {remedy}'
        if UNNAMED not in names:  # the line that names it would have to wait a minute for that which does not
            self._told.tell_state('other publishers', text, error=False)
        return text

    def _log_progress(self) -> None:
        if self.publication.state in (CalibrationState.NONE, CalibrationState.RESTORED) and self._worker.counters.used:
            self._told.tell_progress(self._worker.progress)

    def _open_store(self, image_frame: str) -> Store | None:
        """Return the store of the calibration; None while its name depends on the frame of the first image."""
        url, name = self.node_options.camera_info_url, self._headers.camera_name(image_frame)
        path = resolve_url(url, name or 'camera')
        return Store(path) if name or path == resolve_url(url, 'another') else None

    def _restore(self, store: Store) -> None:
        """Publish the stored calibration of an earlier run, as not yet verified."""
        store.remove_leftovers()
        found = store.load()
        self._told.tell(found.note, good=False)
        if found.stored is None:
            self.get_logger().info(f'no stored calibration at {store.path}')
            return
        try:
            self._pixels.resume(found.stored.given_pixels)
            size = found.stored.calibration.evidence.image_size
            options = self._pixels.present.options_in_view(self.options, size)
            self._follow_regions(None)
            restored = with_current_options(found.stored.calibration, options, self._lens)
            self.publication.restore(restored, found.stored.image_frame)
        except AutocalibError as error:
            self.get_logger().warning(f'the calibration in {store.path} is not restored: {error}')
            return
        self.store_writer.saved = found.stored
        if options != self.options:
            self._worker.change(options, self.node_options.idle_solve_s)
        self._worker.watch_stored(restored, self._stored_views(store, found.stored.calibration))
        self.get_logger().info(f'restored from {store.path}, not yet verified: {describe(restored)}')

    def _stored_views(self, store: Store, calibration: Calibration) -> tuple[KnownView, ...]:
        """Return the stored views of a calibration, none if they are damaged."""
        try:
            views = read_views(store.views, calibration_checksum(calibration))
        except InputError as error:
            self.get_logger().warning(f'the view is not verified by the picture: {error}')
            return ()
        return views

    def _store_views(self) -> None:
        """Store the views of the stored calibration when there are others than those stored last."""
        self._side_files.catch_up()
        calibration, views = self._worker.known
        store, saved = self._store, self.store_writer.saved
        if store is None or calibration is None or saved is None or saved.calibration is not calibration:
            return
        self._side_files.keep_views(store, calibration, views)

    def _to_stored(self, published: Published) -> StoredCalibration:
        return StoredCalibration(
            published.result,
            published.fields,
            self._headers.camera_name(published.image_frame),
            published.image_frame,
            self._pixels.present,
        )

    def _on_accepted(self, published: Published, save: bool) -> None:
        """Pass a calibration that the traffic of this run has confirmed to store and driver, if enabled."""
        if save:
            self._reports.set_evidence(published.result, self._worker.reported_evidence)
        if save and self.node_options.autosave and self._store is not None:
            self.store_writer.offer(self._store, self._to_stored(published))
        if self._upload is not None:
            self._upload.offer(self.publication.camera_info(published))

    def _on_withdrawn(self) -> None:
        """Cancel writes and uploads of the withdrawn calibration that are still pending."""
        self.store_writer.withdraw()
        if self._upload is not None:
            self._upload.withdraw()

    def image_accepted(self, width: int, height: int) -> None:
        """Withdraw a calibration of another image size, because its lens is in pixels of that size."""
        self._unreadable = ''
        views = self._worker.known
        withdrawn = self.publication.on_image_size(width, height)
        self._take_back(width, height)
        if withdrawn is not None:
            state, published = withdrawn
            self._set_aside = (published, views[1] if views[0] is published.result else ())
            self._worker.watch_nothing()
            old_width, old_height = published.result.evidence.image_size
            self._withdrawn = (
                f'{state.value} calibration withdrawn: its images have {old_width}x{old_height} pixels, the present '
                f'ones {width}x{height}'
            )
            self._told.tell_begin('size', f'{self._withdrawn}; collecting new evidence')

    def _take_back(self, width: int, height: int) -> None:
        """Publish the calibration that was withdrawn for another image size again, now that its size is back."""
        if self._set_aside is None or self.publication.published is not None:
            return
        published, views = self._set_aside
        if published.result.evidence.image_size != (width, height):
            return
        self._set_aside = None
        try:
            self.publication.restore(published.result, published.image_frame)
        except AutocalibError as error:
            self.get_logger().warning(f'the calibration of images of {width}x{height} is not published again: {error}')
            return
        self._worker.watch_stored(published.result, views)
        self._withdrawn = ''
        again = describe_briefly(published.result)
        self._told.tell_end('size', f'images have {width}x{height} pixels again: {again}')

    def on_evidence_reset(self, why: str, stamp_ns: int) -> None:
        """Log that the evidence was dropped; the calibration stays until a new one is as precise."""
        self._pictures.forget()
        self.publication.on_evidence_reset()
        self._told.tell_event(f'reset {why}', f'{why} at {clock_text(stamp_ns * 1e-9)}: collecting new evidence')

    def image_unreadable(self, error: AutocalibError) -> None:
        """Log an image that cannot be used."""
        self._unreadable = str(error)
        self._told.tell_state('unreadable', f'image skipped: {error} ({self._worker.counters})')

    def failed(self, error: Exception) -> None:
        """Log a fault of the program or of the machine."""
        self._told.tell_fault(error)

    def solved(self, result: Result) -> None:
        """Publish a calibration unless the current one is more precise; only log a refusal."""
        self._reports.solved(result)
        if isinstance(result, Refusal):
            self._told.tell_refusal(result)
            return
        decision = self.publication.solved(result)
        if decision is None:
            return
        if self.publication.doubt:
            self._worker.doubt()
        if decision.calibration is result:
            self._pixels.adopt()
            self._worker.watch_solved(result)
            self._remember(result, decision.text or 'solved')
        self._withdrawn = ''
        good = not (decision.contradicted or self.publication.doubt)
        self._told.tell_solution(result, decision.text, good=good)

    def _remember(self, result: Calibration, cause: str) -> None:
        """Append a version to the history, beside the stored calibration."""
        if self._store is not None and self.node_options.autosave:
            self._side_files.remember(self._store, version_entry(result, cause, time.time()))

    def picture_moved(self, change: ViewChange, view: int, stamp_ns: int) -> None:
        """Tell a move of which no calibration tells degrees; pixels that were given are less certain by it."""
        if view == 0:
            self._pixels.is_back()
        else:
            self._pixels.displaced(change.displacement_px)
        then = 'the first view is back' if view == 0 else 'evidence from before is not used, collecting begins anew'
        self._told.tell_event(
            f'picture moved {change.kind.name}',
            f'the camera moved until {clock_text(stamp_ns * 1e-9)}: {change}; no lens tells the degrees; {then}',
        )
        self._follow_pixels()

    def view_changed(self, report: ViewReport, stamp_ns: int) -> Calibration | None:
        """Publish, withhold or mend the calibration by what the newest image says about the view."""
        published, mode = self.publication.published, self.node_options.on_move
        text, good = self._events.told(report, stamp_ns, has_calibration=published is not None)
        logged = self._told.tell_view(report, text, good=good)
        unwatched = report.condition is ViewCondition.UNKNOWN and not report.is_watched
        if unwatched or report.condition.is_seen:
            self._pixels.is_back()
            self.publication.release()
        move = report.move
        if move is not None:
            self._pixels.moved(None if published is None else published.result, move)
        self._follow_pixels()
        self._follow_regions(move)
        if move is not None and mode == 'mend' and move.keeps_lens:
            turned = self.publication.mend(move, stamp_ns)
            if turned is not None:
                self._pixels.adopt()
                self._events.mended()
                self._remember(turned.result, f'pose mended, {move}')
                if logged:
                    mended = f'pose mended by what the picture shows: {describe_briefly(turned.result)}'
                    self._told.tell(mended, good=False)
                return turned.result
        if move is not None:
            self.publication.outdate()
        if (move is not None or report.fault is not None) and mode != 'keep':
            self.publication.withhold(text or str(report), is_blind=report.fault is not None)
        return None
