"""Open a model file as an onnxruntime session; onnxruntime is imported only if a model is configured."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from autocalib_ros.config import DetectorOptions
from autocalib_ros.errors import UsageError

LOG_ERRORS = 3
"""Log level of onnxruntime: its warnings concern internal optimisations."""


def open_session(options: DetectorOptions) -> Any:
    """Load the model; UsageError with a one-line reason if it cannot run as configured."""
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
    session_options = runtime.SessionOptions()
    session_options.intra_op_num_threads = options.threads
    session_options.inter_op_num_threads = 1
    session_options.log_severity_level = LOG_ERRORS
    # Spinning threads take the processor from the tracker: 35 ms instead of 13 ms per detection.
    session_options.add_session_config_entry('session.intra_op.allow_spinning', '0')
    try:
        session = runtime.InferenceSession(str(path), sess_options=session_options, providers=wanted)
    except Exception as error:  # onnxruntime raises many unrelated exception classes
        raise UsageError(f"'detector.model' {path} cannot be loaded: {' '.join(str(error).split())}") from error
    running = session.get_providers()
    if wanted[0] not in running:
        raise UsageError(
            f"'detector.providers' asks for {wanted[0]}, which onnxruntime has but could not start: it "
            f'would run on {", ".join(running)}'
        )
    return session


def _providers(text: str, available: list[str]) -> list[str]:
    """Return the providers listed in a text; UsageError if one is not available."""
    wanted = text.replace(',', ' ').split()
    missing = [name for name in wanted if name not in available]
    if missing or not wanted:
        raise UsageError(
            f"'detector.providers' asks for {missing[0] if missing else 'none'}; this onnxruntime has "
            f'{", ".join(available)}'
        )
    return wanted
