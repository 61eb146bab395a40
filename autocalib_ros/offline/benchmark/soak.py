"""A day and a night of a live node, faster than real time: memory, descriptors, threads, log and answer over time.

The node runs in a process of its own with all that it keeps for long: perception, evidence, schedule, solver process,
watch of the view, history and files. Its images are those of `long_stream`. For some hours they come at a video rate,
with traffic in them. In the others they come every `SPARSE_S` without moving traffic, and what its perception would
have made of the traffic comes with them: the observations of the recording, repeated.
"""

from __future__ import annotations

import contextlib
import csv
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from autocalib_ros.calibrator import AutoCalibrator
from autocalib_ros.config import Options
from autocalib_ros.errors import AutocalibError, InputError
from autocalib_ros.offline.benchmark.long_stream import LongStream, ShortRecording
from autocalib_ros.offline.benchmark.repeated_traffic import RepeatedTraffic

DENSE_HZ, SPARSE_S = 5.0, 1.8
"""Rate of the images with traffic in them, and the interval of the others, seconds: eight are in the time over which
the watch of the view averages, as many as it needs."""
SLICES = 4
"""Parts into which the hours with traffic in the images are cut, evenly over the run: by day and by night."""
MOST_LEARNT_S = 180.0
"""Most time of the recording, to and fro, whose observations are repeated, seconds."""
SAMPLE_S = 600.0
"""Simulated seconds between two looks at the process."""
FIRST_STAMP_NS = 1_700_000_000_000_000_000
NODE_MODULE = 'autocalib_ros.ros.piped_node'
WARM_UP, EARLY, LATE = 0.25, 0.5, 0.75
"""Parts of the run: after the first the buffers are full, and the time from there to the second is compared with that
after the third."""
MEMORY_GROWTH_MB, COUNT_GROWTH = 10.0, 1.0
"""Largest growth of the memory between these two that counts as flat: what the allocator keeps varies by some MB; and
of descriptors and threads, of which a solution that is under way has one or two more."""
LOG_LINES_AN_HOUR = 6.0
"""Most lines of log in an hour: a person reads some lines of a day."""
ANSWER_SIGMAS = 3.0
"""Largest change of the focal length, in its standard deviations."""


@dataclass(frozen=True)
class SoakSample:
    """The process at one moment."""

    hour: float
    daylight: float
    real_s: float
    memory_mb: float
    """Resident memory of the node."""
    solver_mb: float
    """Resident memory of its children."""
    descriptors: int
    threads: int
    log_lines: int
    files_kb: float
    """Size of what the node stored."""
    ms_per_image: float
    """Processor time of the node since the sample before, divided by its images: traffic is in the dear ones."""
    images: int
    lost: int
    state: str
    view: str
    focal_px: float
    """Of the published calibration; nan without one. So are the next three."""
    focal_sigma_px: float
    tilt_deg: float
    tilt_sigma_deg: float
    tracks: int


@dataclass(frozen=True)
class SoakPlan:
    """How long to run, and how much of it with traffic in the images; hours are simulated."""

    hours: float
    image_hours: float
    day_hours: float
    camera_height_m: float

    def is_dense(self, time_s: float) -> bool:
        """Whether traffic is in the images of a time."""
        part_s = 3600.0 * self.hours / SLICES
        return time_s % part_s < 3600.0 * self.image_hours / SLICES


def soak(recording: ShortRecording, plan: SoakPlan, log: Path) -> Iterator[SoakSample]:
    """Run a node and yield its samples; `log` is where its log goes. AutocalibError if the node ends."""
    stream = LongStream(recording, 3600.0 * plan.day_hours)
    traffic = RepeatedTraffic(_learnt(stream, plan))
    with tempfile.TemporaryDirectory() as folder, _running_node(Path(folder), plan, log) as (process, pipe):
        began, probe = time.monotonic(), _Probe(process.pid, Path(folder), log)
        time_s, due_s = 0.0, min(SAMPLE_S, 3600.0 * plan.hours)
        try:
            while time_s < 3600.0 * plan.hours:
                dense = plan.is_dense(time_s)
                step_s = 1.0 / DENSE_HZ if dense else SPARSE_S
                seen = None if dense else traffic.between(time_s, time_s + step_s)
                stamp_ns = FIRST_STAMP_NS + round(time_s * 1e9)
                pipe.send((stamp_ns, stream.image(time_s, traffic=dense), seen))
                time_s += step_s
                if time_s >= due_s:
                    due_s += SAMPLE_S
                    pipe.send(None)
                    yield probe.sample(pipe.recv(), time_s, stream.daylight(time_s), time.monotonic() - began)
        except (OSError, EOFError) as error:
            raise AutocalibError(f'the node ended after {time_s / 3600.0:.1f} simulated hours, see {log}') from error


def _learnt(stream: LongStream, plan: SoakPlan) -> Any:
    """Return the evidence of the first images."""
    calibrator = AutoCalibrator(Options(camera_height=plan.camera_height_m))
    for number in range(round(min(MOST_LEARNT_S, stream.period_s) * DENSE_HZ)):
        calibrator.add_image(FIRST_STAMP_NS + round(1e9 * number / DENSE_HZ), stream.image(number / DENSE_HZ))
    return calibrator.snapshot(with_segments=False)


@contextlib.contextmanager
def _running_node(folder: Path, plan: SoakPlan, log: Path) -> Iterator[tuple[subprocess.Popen, Connection]]:
    """Run a node that stores its files in a folder; end it in order."""
    ours, its = Pipe()
    given = {'camera_height': plan.camera_height_m, 'camera_info_url': f'file://{folder}/camera.yaml'}
    parameters = [text for name, value in given.items() for text in ('-p', f'{name}:={value}')]
    command = [sys.executable, '-m', NODE_MODULE, str(its.fileno()), '--ros-args', *parameters]
    variables = {
        'ROS_LOG_DIR': str(folder / 'log'),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_DOMAIN_ID': str(os.getpid() % 100 + 1),
    }
    with (
        log.open('w', encoding='utf-8') as stream,
        subprocess.Popen(command, stderr=stream, pass_fds=(its.fileno(),), env={**os.environ, **variables}) as process,
    ):
        its.close()
        try:
            yield process, ours
        finally:
            ours.close()
            try:
                process.wait(timeout=30.0)
            except subprocess.TimeoutExpired:
                process.kill()


class _Probe:
    """Looks at a process from outside."""

    def __init__(self, pid: int, folder: Path, log: Path) -> None:
        self._pid, self._folder, self._log = pid, folder, log
        self._spent_s, self._images = 0.0, 0

    def sample(self, numbers: dict[str, Any], time_s: float, daylight: float, real_s: float) -> SoakSample:
        status = Path(f'/proc/{self._pid}/status').read_text(encoding='ascii')
        spent_s, images = _processor_s(self._pid), int(numbers['used'])
        ms = 1e3 * (spent_s - self._spent_s) / max(1, images - self._images)
        self._spent_s, self._images = spent_s, images
        stored = sum(path.stat().st_size for path in self._folder.glob('*') if path.is_file())
        number = {key: np.nan if numbers[key] is None else float(numbers[key]) for key in ANSWER}
        return SoakSample(
            hour=time_s / 3600.0,
            daylight=daylight,
            real_s=real_s,
            memory_mb=_kb(status, 'VmRSS') / 1024.0,
            solver_mb=sum(_child_mb(child) for child in _children(self._pid)),
            descriptors=len(os.listdir(f'/proc/{self._pid}/fd')),
            threads=int(_kb(status, 'Threads')),
            log_lines=len(self._log.read_text(encoding='utf-8').splitlines()),
            files_kb=stored / 1024.0,
            ms_per_image=ms,
            images=images,
            lost=int(numbers['lost']),
            state=str(numbers['state']),
            view=str(numbers['view']),
            tracks=int(numbers['tracks']),
            **number,
        )


ANSWER = ('focal_px', 'focal_sigma_px', 'tilt_deg', 'tilt_sigma_deg')
"""Values of the published calibration in a sample."""


def _kb(status: str, key: str) -> float:
    found = re.search(rf'^{key}:\s*(\d+)', status, re.MULTILINE)
    return float(found[1]) if found else 0.0


def _processor_s(pid: int) -> float:
    """Return the processor time of a process, seconds."""
    words = Path(f'/proc/{pid}/stat').read_text(encoding='utf-8').rpartition(')')[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf('SC_CLK_TCK')


def _children(pid: int) -> list[int]:
    return [
        int(word)
        for path in Path(f'/proc/{pid}/task').glob('*/children')
        for word in path.read_text(encoding='ascii').split()
    ]


def _child_mb(pid: int) -> float:
    with contextlib.suppress(OSError):  # it may just have ended
        return _kb(Path(f'/proc/{pid}/status').read_text(encoding='ascii'), 'VmRSS') / 1024.0
    return 0.0


@dataclass(frozen=True)
class SoakCheck:
    """One quantity that has to be flat."""

    name: str
    early: float
    late: float
    limit: float
    """Largest difference."""

    @property
    def is_flat(self) -> bool:
        """Whether it is."""
        return abs(self.late - self.early) <= self.limit


def soak_checks(samples: Sequence[SoakSample]) -> list[SoakCheck]:
    """Compare the time after the warm-up with the end, by medians; growth alone counts but for the answer."""
    end = samples[-1].hour
    early = [each for each in samples if WARM_UP * end <= each.hour <= EARLY * end] or list(samples[:1])
    late = [each for each in samples if each.hour >= LATE * end] or list(samples[-1:])

    def check(name: str, key: str, limit: float) -> SoakCheck:
        before, after = (float(np.median([getattr(each, key) for each in part])) for part in (early, late))
        return SoakCheck(name, before, max(before, after), limit)

    sigma = float(np.median([each.focal_sigma_px for each in early]))
    first, last = (float(np.median([each.focal_px for each in part])) for part in (early, late))
    lines = samples[-1].log_lines / max(end, 1e-9)
    return [
        check('memory of the node, MB', 'memory_mb', MEMORY_GROWTH_MB),
        check('memory of the solver, MB', 'solver_mb', MEMORY_GROWTH_MB),
        check('descriptors', 'descriptors', COUNT_GROWTH),
        check('threads', 'threads', COUNT_GROWTH),
        check('stored files, kB', 'files_kb', 1024.0),
        SoakCheck('lines of log an hour', 0.0, lines, LOG_LINES_AN_HOUR),
        SoakCheck('focal length, px', first, last, ANSWER_SIGMAS * sigma),
    ]


def format_soak_sample(each: SoakSample) -> str:
    """Return one line of the table."""
    return (
        f'{each.hour:>6.2f}{each.daylight:>9.2f}{each.real_s:>8.0f}{each.memory_mb:>9.0f}{each.solver_mb:>8.0f}'
        f'{each.descriptors:>6}{each.threads:>8}{each.log_lines:>7}{each.files_kb:>8.0f}{each.ms_per_image:>10.1f}'
        f'{each.images:>8}{each.lost:>6}  {each.state:<11}{each.focal_px:>8.1f} ± {each.focal_sigma_px:<6.2f}'
        f'{each.tilt_deg:>8.2f} ± {each.tilt_sigma_deg:<6.3f}{each.tracks:>6}  {each.view}'
    )


SOAK_HEADER = (
    f'{"hour":>6}{"daylight":>9}{"real s":>8}{"node MB":>9}{"solver":>8}{"fds":>6}{"threads":>8}{"lines":>7}'
    f'{"kB":>8}{"ms/image":>10}{"images":>8}{"lost":>6}  {"state":<11}{"focal length, px":>18}{"tilt, degrees":>19}'
    f'{"tracks":>9}  view'
)


def format_soak_checks(checks: Sequence[SoakCheck]) -> str:
    """Return the verdicts."""
    return '\n'.join(
        f'{each.name:<26}{each.early:>10.2f} to {each.late:<10.2f} allowed {each.limit:<8.2f}'
        f'{"flat" if each.is_flat else "NOT FLAT"}'
        for each in checks
    )


def read_samples(path: Path) -> list[SoakSample]:
    """Read what `write_samples` wrote. InputError if the file is another one."""
    try:
        with path.open(newline='', encoding='utf-8') as stream:
            return [
                SoakSample(**{each.name: TYPES[str(each.type)](row[each.name]) for each in fields(SoakSample)})
                for row in csv.DictReader(stream)
            ]
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f'{path}: no samples of a soak ({type(error).__name__}: {error})') from error


TYPES: dict[str, Callable[[str], Any]] = {'float': float, 'int': int, 'str': str}
"""Types of the columns of a file of samples."""


def write_samples(path: Path, samples: Sequence[SoakSample]) -> None:
    """Write the samples as CSV, one row each."""
    with path.open('w', newline='', encoding='utf-8') as stream:
        writer = csv.DictWriter(stream, [each.name for each in fields(SoakSample)], lineterminator='\n')
        writer.writeheader()
        writer.writerows(asdict(each) for each in samples)
