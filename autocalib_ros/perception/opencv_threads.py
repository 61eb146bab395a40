"""Threads of OpenCV in the programs of this package; whoever imports it keeps those of their own program."""

from __future__ import annotations

import cv2

OPENCV_THREADS = 1
"""Threads of OpenCV in node and replay. An image is a dozen steps of a millisecond or less: threads would wait for each
other most of the time, and take the cores from solutions, decoders and other cameras."""


def pin_opencv_threads() -> None:
    """Set the number of threads that OpenCV uses in this process."""
    cv2.setNumThreads(OPENCV_THREADS)
