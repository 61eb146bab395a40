"""Images of another size than before: believed once they last."""

from __future__ import annotations

MIN_RESIZED_S, MIN_RESIZED_IMAGES = 3.0, 5
"""Time by the stamps and number of images in a row for which a new size lasts before it is believed: drivers that
reconnect send a few odd images, a camera that changes its mode keeps it."""


class SizeChange:
    """Counts the images of a new size in a row."""

    def __init__(self) -> None:
        self._seen: tuple[tuple[int, int], int, int] | None = None

    def has_lasted(self, size: tuple[int, int], stamp_ns: int) -> bool:
        """Count an image of a new size (width, height); return whether that size is to be believed."""
        before, since_ns, count = self._seen or (size, stamp_ns, 0)
        if before != size or stamp_ns < since_ns:
            since_ns, count = stamp_ns, 0
        self._seen = (size, since_ns, count + 1)
        return count + 1 >= MIN_RESIZED_IMAGES and stamp_ns - since_ns >= MIN_RESIZED_S * 1e9
