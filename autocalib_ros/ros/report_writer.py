"""Reports of a live node, written by a process of their own: drawing takes seconds, and would hold Python's lock."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np

from autocalib_ros.config import Options
from autocalib_ros.evidence.buffer import EvidenceBuffer
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.report.scene import ReportScene, SolutionSnapshot, append_snapshot
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.ros.solver_process import NICENESS
from autocalib_ros.util.threads import limit_blas_threads

PROCESS_EXIT_S = 1.0


@dataclass(frozen=True)
class ReportPaths:
    """Where a report goes."""

    page: Path
    figures: Path


class ReportWriter:
    """Remembers what a report shows of the solutions, and writes one after the other; of those that wait, the newest.

    Callable from any thread. `tell(text, good)` hears from a thread what became of each.
    """

    def __init__(self, tell: Callable[[str, bool], None]) -> None:
        self._tell = tell
        self._changed = threading.Condition()
        self._moments: tuple[SolutionSnapshot, ...] = ()
        self._accepted: tuple[Calibration, Evidence] | None = None
        self._next: tuple[ReportPaths, ReportScene] | None = None
        self._thread: threading.Thread | None = None
        self._process: BaseProcess | None = None
        self._closed = False

    def solved(self, result: Calibration | Refusal) -> None:
        """Take down what a solution says."""
        with self._changed:
            self._moments = append_snapshot(self._moments, result)

    def set_evidence(self, result: Calibration, evidence: Evidence | None) -> None:
        """Keep the evidence of the calibration that is in force from now on."""
        with self._changed:
            self._accepted = None if evidence is None else (result, evidence)

    def forget(self) -> None:
        """Forget what solutions said, and what they rest on."""
        with self._changed:
            self._moments, self._accepted = (), None

    def scene(
        self, result: Calibration, seen: tuple[Evidence | None, np.ndarray | None], options: Options, source: str
    ) -> ReportScene:
        """Put together what a report of a calibration shows, with what is `seen` now."""
        evidence, background = seen
        with self._changed:
            if self._accepted is not None and self._accepted[0] is result:
                evidence = self._accepted[1]
            moments = self._moments
        if evidence is None or evidence.image_size != result.evidence.image_size:
            evidence, background = _empty_evidence(result, options), None
        return ReportScene(
            result=result, evidence=evidence, background=background, options=options, source=source, moments=moments
        )

    def write(self, place: ReportPaths, scene: ReportScene) -> None:
        """Write a report soon."""
        with self._changed:
            if self._closed:
                return
            self._next = (place, scene)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name='reports', daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def close(self) -> None:
        """Write no more, and give up what is being written; what was there before stays."""
        with self._changed:
            self._closed, self._next = True, None
            process = self._process
            self._changed.notify_all()
        if process is not None:
            process.kill()
        if self._thread is not None:
            self._thread.join(PROCESS_EXIT_S)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._next)
                if self._closed:
                    return
                (place, scene), self._next = self._next, None
                # Not forked: a fork would share the locks of the parent's threads and its middleware.
                context = multiprocessing.get_context('spawn')
                ours, theirs = context.Pipe(duplex=False)
                process = self._process = context.Process(
                    target=_write, args=(theirs, place, scene), name='autocalib report', daemon=True
                )
                process.start()
            theirs.close()
            fault = self._wait_for(process, ours)
            if not self._closed:
                self._tell(
                    f'the report was not written: {fault}' if fault else f'the report is written: {place.page}',
                    not fault,
                )

    @staticmethod
    def _wait_for(process: BaseProcess, ours: Connection) -> str:
        """Wait for a process that writes a report; return why that failed, '' where it did not."""
        try:
            fault = ours.recv()
        except (EOFError, OSError):
            fault = 'the process that draws it ended before it was done: is there enough memory?'
        ours.close()
        process.join(PROCESS_EXIT_S)
        return fault


def _write(pipe: Connection, place: ReportPaths, scene: ReportScene) -> None:
    """Draw and write, behind everything else on the machine, and say what failed."""
    os.nice(NICENESS)
    limit_blas_threads()
    try:
        from autocalib_ros.report.page import write_report

        write_report(place.page, scene, place.figures)
        pipe.send('')
    except Exception as error:  # whatever it is, the node lives on without a report
        pipe.send(f'{type(error).__name__}: {error}')


def _empty_evidence(result: Calibration, options: Options) -> Evidence:
    """Return evidence without traffic, for a calibration of an earlier run."""
    return EvidenceBuffer(options.buffer).snapshot(
        image_size=result.evidence.image_size,
        first_stamp_ns=result.newest_stamp_ns,
        newest_stamp_ns=result.newest_stamp_ns,
        frames=0,
        drift_px=0.0,
        unfinished=[],
    )
