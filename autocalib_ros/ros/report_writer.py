"""Reports of the live node, written in a child process: drawing takes seconds and would hold the GIL."""

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
from autocalib_ros.solver_process import NICENESS, PROCESS_EXIT_S
from autocalib_ros.util.threads import limit_blas_threads


@dataclass(frozen=True)
class ReportPaths:
    """Output paths of a report: the page and the folder of its figures."""

    page: Path
    figures: Path


class ReportWriter:
    """Collects the solutions that a report shows, and writes reports one at a time, of those pending the newest.

    Thread-safe. `log(text, good=)` is called from its thread with the outcome of each report.
    """

    def __init__(self, log: Callable[[str, bool], None]) -> None:
        self._log = log
        self._changed = threading.Condition()
        self._moments: tuple[SolutionSnapshot, ...] = ()
        self._accepted: tuple[Calibration, Evidence] | None = None
        self._next: tuple[ReportPaths, ReportScene] | None = None
        self._thread: threading.Thread | None = None
        self._process: BaseProcess | None = None
        self._closed = False

    def solved(self, result: Calibration | Refusal) -> None:
        """Append a result to the history of solutions."""
        with self._changed:
            self._moments = append_snapshot(self._moments, result)

    def set_evidence(self, result: Calibration, evidence: Evidence | None) -> None:
        """Keep the evidence of a newly accepted calibration."""
        with self._changed:
            self._accepted = None if evidence is None else (result, evidence)

    def forget(self) -> None:
        """Drop the history and the evidence."""
        with self._changed:
            self._moments, self._accepted = (), None

    def scene(
        self, result: Calibration, seen: tuple[Evidence | None, np.ndarray | None], options: Options, source: str
    ) -> ReportScene:
        """Return the contents of a report: `seen` is the present evidence and background image."""
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

    def write(self, paths: ReportPaths, scene: ReportScene) -> None:
        """Start to write a report; a newer one replaces it while it waits."""
        with self._changed:
            if self._closed:
                return
            self._next = (paths, scene)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name='reports', daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def close(self) -> bool:
        """Abort the report that is being written and drop the pending one; the previous report stays.

        Return whether there was nothing to give up.
        """
        with self._changed:
            pending, self._closed, self._next = self._next is not None, True, None
            process = self._process
            self._changed.notify_all()
        drawing = process is not None and process.is_alive()
        if process is not None:
            process.kill()
        if self._thread is not None:
            self._thread.join(PROCESS_EXIT_S)
        return not (pending or drawing)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._next)
                if self._closed or self._next is None:
                    return
                (paths, scene), self._next = self._next, None
                # spawn, not fork: a fork would copy locks held by the parent's threads and its middleware
                context = multiprocessing.get_context('spawn')
                ours, theirs = context.Pipe(duplex=False)
                process = self._process = context.Process(
                    target=_write, args=(theirs, paths, scene), name='autocalib report', daemon=True
                )
                process.start()
            theirs.close()
            fault = self._wait_for(process, ours)
            if not self._closed:
                self._log(
                    f'the report was not written: {fault}' if fault else f'report written to {paths.page}', not fault
                )

    @staticmethod
    def _wait_for(process: BaseProcess, ours: Connection) -> str:
        """Wait for the child process; return why it failed, '' if it succeeded."""
        try:
            fault = ours.recv()
        except (EOFError, OSError):
            fault = 'the process that draws it ended early, possibly out of memory'
        ours.close()
        process.join(PROCESS_EXIT_S)
        return fault


def _write(pipe: Connection, paths: ReportPaths, scene: ReportScene) -> None:
    """Draw and write a report at low priority; send '' or the error."""
    os.nice(NICENESS)
    limit_blas_threads()
    try:
        from autocalib_ros.report.page import write_report

        write_report(paths.page, scene, paths.figures)
        pipe.send('')
    except Exception as error:  # the node works without a report
        pipe.send(f'{type(error).__name__}: {error}')


def _empty_evidence(result: Calibration, options: Options) -> Evidence:
    """Return evidence without traffic, for a calibration restored from an earlier run."""
    return EvidenceBuffer(options.buffer).snapshot(
        image_size=result.evidence.image_size,
        first_stamp_ns=result.newest_stamp_ns,
        newest_stamp_ns=result.newest_stamp_ns,
        frames=0,
        drift_px=0.0,
        unfinished=[],
    )
