"""Render an image, video or bag into one picture or a video."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.offline.recordings.open import open_source
from autocalib_ros.offline.recordings.sources import Source
from autocalib_ros.offline.recordings.videos import FALLBACK_FPS
from autocalib_ros.offline.terminal.progress import progress_bar
from autocalib_ros.perception.image_file import read_image
from autocalib_ros.util.files import create_for_picture

PICTURE_SUFFIXES = ('.png', '.jpg', '.jpeg')
VIDEO_CODECS = {'.mp4': 'mp4v', '.avi': 'MJPG'}
IMAGE_SUFFIXES = (*PICTURE_SUFFIXES, '.bmp', '.tif', '.tiff', '.webp', '.pgm', '.ppm')
JPEG_QUALITY = 88

Renderer = Callable[[np.ndarray], np.ndarray]
"""Renders an image, grey (H, W) or BGR (H, W, 3) uint8, as a BGR uint8 picture."""


@dataclass(frozen=True)
class SourceSelection:
    """Selected images of a recording; a picture shows the first of them."""

    topic: str | None = None
    start_s: float = 0.0
    duration_s: float | None = None


def write_view(
    source: Path,
    out: Path,
    selection: SourceSelection,
    renderer_for: Callable[[int, int], Renderer],
    *,
    label: str,
    quiet: bool = False,
) -> tuple[int, int]:
    """Render the images of a source with `renderer_for(width, height)`; return width and height of the output.

    An existing file is replaced only once the new one is complete. Raise UsageError for incompatible file names,
    InputError if a file cannot be read or written.
    """
    _check(source, out, selection)
    if source.suffix.lower() in IMAGE_SUFFIXES:
        return _write_picture(out, _render(renderer_for, read_image(source)))
    recording = open_source(source, selection.topic, selection.start_s, selection.duration_s)
    if out.suffix.lower() in PICTURE_SUFFIXES:
        return _write_picture(out, _render(renderer_for, next(iter(recording.frames())).image))
    return _write_video(recording, out, renderer_for, label, quiet)


def _check(source: Path, out: Path, selection: SourceSelection) -> None:
    kind = out.suffix.lower()
    if kind not in (*PICTURE_SUFFIXES, *VIDEO_CODECS):
        raise UsageError(f'{out} is neither a picture nor a video: use {", ".join((*PICTURE_SUFFIXES, *VIDEO_CODECS))}')
    if out.is_dir():
        raise UsageError(f'{out} is a folder, not a file')
    if out.exists() and source.exists() and out.samefile(source):
        raise UsageError(f'{out} is the source itself: choose another name for the result')
    if source.suffix.lower() in IMAGE_SUFFIXES and (kind in VIDEO_CODECS or selection != SourceSelection()):
        raise UsageError(
            f'{source} is one image: write one picture ({", ".join(PICTURE_SUFFIXES)}) of it, without --at,'
            ' --duration and --topic'
        )
    if kind in PICTURE_SUFFIXES and selection.duration_s is not None:
        raise UsageError(f'{out} is one picture, and --duration is for videos: give --at alone')


def _render(renderer_for: Callable[[int, int], Renderer], image: np.ndarray) -> np.ndarray:
    return renderer_for(image.shape[1], image.shape[0])(image)


def _write_picture(out: Path, picture: np.ndarray) -> tuple[int, int]:
    with _atomic_output(out) as unfinished:
        encoded, data = cv2.imencode(out.suffix.lower(), picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        if not encoded:
            raise InputError(f'cannot write {out}: OpenCV has no encoder for {out.suffix}')
        unfinished.write_bytes(data.tobytes())
    return picture.shape[1], picture.shape[0]


def _write_video(
    recording: Source, out: Path, renderer_for: Callable[[int, int], Renderer], label: str, quiet: bool
) -> tuple[int, int]:
    view: Renderer | None = None
    writer: cv2.VideoWriter | None = None
    size = (0, 0)  # set by the first frame; `frames` raises InputError without one
    with _atomic_output(out) as unfinished, progress_bar(recording.total, 'images', label, quiet=quiet) as progress:
        try:
            for count, frame in enumerate(recording.frames(), start=1):
                view = view or renderer_for(frame.image.shape[1], frame.image.shape[0])
                picture = view(frame.image)
                if writer is None:
                    size = (
                        picture.shape[1] // 2 * 2,
                        picture.shape[0] // 2 * 2,
                    )  # even sizes: codecs subsample the colours by two
                    writer = _open_writer(out, unfinished, _frame_rate(recording), size)
                writer.write(np.ascontiguousarray(picture[: size[1], : size[0]]))
                progress.update_to(count)
        finally:
            if writer is not None:
                writer.release()
    return size


def _open_writer(out: Path, unfinished: Path, rate: float, size: tuple[int, int]) -> cv2.VideoWriter:
    codec = VIDEO_CODECS[out.suffix.lower()]
    writer = cv2.VideoWriter(str(unfinished), _fourcc(codec), rate, size)
    if not writer.isOpened():
        raise InputError(
            f'cannot write {out}: this OpenCV cannot encode {codec} of {size[0]}x{size[1]} there; choose'
            ' .avi, or another folder'
        )
    return writer


def _fourcc(codec: str) -> int:
    return cv2.VideoWriter_fourcc(*codec)  # type: ignore[attr-defined]  # missing in OpenCV's type stubs


def _frame_rate(recording: Source) -> float:
    return recording.total / recording.duration_s if recording.total and recording.duration_s else FALLBACK_FPS


@contextmanager
def _atomic_output(out: Path) -> Iterator[Path]:
    """Yield a temporary path that replaces `out` at the end; it is removed after an error."""
    unfinished = out.with_name(f'.{out.stem}~{os.getpid()}{out.suffix}')
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        create_for_picture(unfinished)
        yield unfinished
        os.replace(unfinished, out)
    except OSError as error:
        raise InputError(f'cannot write {out}: {error.strerror or error}') from error
    finally:
        with suppress(OSError):
            unfinished.unlink()
