"""A model file as a session of onnxruntime, which is imported here and only when a model is asked for."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from autocalib_ros.config import DetectorOptions
from autocalib_ros.errors import UsageError

LOG_ERRORS = 3
"""Of onnxruntime's levels: its warnings are about its own optimisations."""


def open_session(options: DetectorOptions) -> Any:
    """Load the model; UsageError, in one line, where it cannot be run as asked for."""
    path = Path(options.model).expanduser()
    if not path.is_file():
        raise UsageError(f"'detector.model' is {options.model}, which is not a file: give a detector in ONNX")
    try:
        runtime = importlib.import_module('onnxruntime')
    except ImportError as error:
        raise UsageError(
            f"'detector.model' needs onnxruntime, which cannot be imported ({error}): pip install "
            'onnxruntime, or leave the model out'
        ) from error
    wanted = _providers(options.providers, runtime.get_available_providers())
    how = runtime.SessionOptions()
    how.intra_op_num_threads = options.threads
    how.inter_op_num_threads = 1
    how.log_severity_level = LOG_ERRORS
    # Threads that spin while they wait take the processor from those that track: 35 ms instead of 13 a detection.
    how.add_session_config_entry('session.intra_op.allow_spinning', '0')
    try:
        session = runtime.InferenceSession(str(path), sess_options=how, providers=wanted)
    except Exception as error:  # onnxruntime has a class of its own for each reason, none with a common root
        raise UsageError(f"'detector.model' {path} cannot be loaded: {' '.join(str(error).split())}") from error
    running = session.get_providers()
    if wanted[0] not in running:
        raise UsageError(
            f"'detector.providers' asks for {wanted[0]}, which onnxruntime has but could not start: it "
            f'would run on {", ".join(running)}'
        )
    return session


def _providers(text: str, available: list[str]) -> list[str]:
    """Return the providers named in a text, or raise UsageError at one that is not there."""
    wanted = text.replace(',', ' ').split()
    missing = [name for name in wanted if name not in available]
    if missing or not wanted:
        raise UsageError(
            f"'detector.providers' asks for {missing[0] if missing else 'none'}; this onnxruntime has "
            f'{", ".join(available)}'
        )
    return wanted
