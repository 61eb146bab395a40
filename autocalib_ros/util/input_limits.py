"""Limits of what is read from files and messages, checked before memory is taken for it."""

from __future__ import annotations

MAX_DOCUMENT_BYTES = 1_000_000
"""Most bytes of a parameter file, cameras.yaml, camera_info, calibration.json, history or truth: the longest that this
program writes has less than 100 kB."""
MAX_METADATA_BYTES = 10_000_000
"""Most bytes of the metadata.yaml of a recording, which lists every topic and every file."""
MAX_TABLE_BYTES = 100_000_000
"""Most bytes of a table of tracks or control points: a day of a busy junction at 25 images a second."""
MAX_DEPTH = 50
"""Most levels of lists and names in each other; parameters have four."""
MAX_NODES = 100_000
"""Most values of a document with its YAML aliases written out: a CameraInfo has 50, a metadata.yaml 20 per topic."""
MAX_NUMBER_CHARACTERS = 100
"""Longest text of a number: a float in full precision has 24 characters."""
MAX_INTEGER = 2**64
"""Largest whole number, exclusive: stamps are nanoseconds in 64 bits. Every such number is a float too."""
MAX_IMAGE_PIXELS = 100_000_000
"""Most pixels of an image: three times those of 8K, and 300 MB when decoded in colour."""
MAX_EVIDENCE_BYTES = 500_000_000
"""Most bytes of an unpacked file of evidence: a full buffer has 10 MB, and recordings are joined by the ten."""
MAX_CHUNK_BYTES = 500_000_000
"""Most bytes of an unpacked message or chunk of a recording: a raw image of `MAX_IMAGE_PIXELS` in colour; recorders
close their chunks after 4 MB, or after the first larger message."""
MAX_PACKED_RATIO, ALWAYS_UNPACKED_BYTES = 1000, 1_000_000_000
"""Most bytes of a recording that was compressed as a whole, for each of its own, and the size up to which any ratio
will do: raw images of a real sensor shrink to a fifth, drawn ones without noise to a hundredth."""
MIN_FREE_BYTES = 1_000_000_000
"""Least room left on the disk beside copies of recordings, for what else the computer writes."""
MAX_MODEL_SIDE_PX = 8192
"""Longest side of the input of a detector: its tensor has 0.8 GB then."""
MAX_CLASSES = 10_000
"""Most classes of a detector; the largest vocabulary of detectors, LVIS, has 1203."""
MAX_CLASS_TEXT = 1_000_000
"""Most characters of the class names in the metadata of a detector: a hundred each."""
