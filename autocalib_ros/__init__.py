"""Calibrate a fixed roadside camera from the traffic that it sees.

    from autocalib_ros import Ground, Options, replay

The names of `PUBLIC` are imported when they are first used, so that importing the package stays quick.
"""

from importlib import import_module
from typing import Any

__version__ = '0.1.0'
PUBLIC = {
    'Ground': 'autocalib_ros.ground',
    'Options': 'autocalib_ros.config',
    'replay': 'autocalib_ros.offline.replay_recording',
}
"""Public names and the modules that define them."""
__all__ = ['Ground', 'Options', 'replay']


def __getattr__(name: str) -> Any:
    if name in PUBLIC:
        return getattr(import_module(PUBLIC[name]), name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')


def __dir__() -> list[str]:
    return sorted({*globals(), *PUBLIC})
