"""The command to try next after a refusal, or for a better result, as it can be copied."""

from __future__ import annotations

import shlex
from pathlib import Path

from autocalib_ros.config import Options, walk_options
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.results.refusals import TELL_LENS

TELL = {
    'no_height': '--camera-height METRES',
    'implausible': '--camera-height METRES',
    'scale_uncertain': '--camera-height METRES',
    'scale_off_road': '--distance U1 V1 U2 V2 METRES',
    'pixel_aspect': '-p lens.pixel_aspect:=1.0',
    'distortion_model': '-p distortion_model:=equidistant',
    'vanishing_points_disagree': '--method joint',
    'given_lens': '',
}
"""What is told on the command line after a refusal that needs no other images, by code."""
MEASURED = {
    'focal': '--hfov-deg DEGREES',
    'height': '--camera-height METRES',
    'length_along': '--distance U1 V1 U2 V2 METRES',
    'length_across': '--distance U1 V1 U2 V2 METRES',
    'roll': '--roll-sigma-deg 1',
}
"""How a helpful measure is told, by its kind."""


FLAGS = {
    'camera_height': '--camera-height',
    'camera_height_sigma': '--camera-height-sigma',
    'scale.speed_km_h': '--scale-speed',
    'lanes.country': '--lanes',
    'lanes.width_m': '--lane-width',
    'lanes.dash_period_m': '--dash-period',
    'lens.focal_px': '--focal-px',
    'lens.focal_sigma_px': '--focal-sigma-px',
    'lens.hfov_deg': '--hfov-deg',
    'joint.roll_prior_deg': '--roll-sigma-deg',
    'method': '--method',
}
"""Options that have a flag of their own, with one value."""


def next_command(result: Calibration | Refusal, options: Options, folder: Path | None) -> str:
    """Return the command that follows the remedy, words in capitals to be replaced; '' if nothing is to be tried.

    What needs no further images solves the saved evidence in `folder` again; '' without a folder.
    """
    refusal = result if isinstance(result, Refusal) else result.ground_refusal
    found = result.candidate
    if folder is None or (refusal is None and (found is None or found.helpful is None)):
        return ''
    told = ''
    if refusal is not None and refusal.code in TELL:
        told = TELL[refusal.code]
    elif found is not None and found.helpful is not None:
        told = MEASURED.get(found.helpful.kind, '')
    elif refusal is not None and TELL_LENS in refusal.remedy:
        told = MEASURED['focal']
    elif refusal is not None:
        resume = '--resume ' if refusal.remedy.startswith('wait') else ''
        return f'autocalib replay NEW_RECORDING {resume}{_told_so_far(options, "")}--out {shlex.quote(str(folder))}'
    again = f'autocalib evidence {shlex.quote(str(folder / "evidence.npz"))} {_told_so_far(options, told)}{told}'
    return f'{again.rstrip()} --out {shlex.quote(str(folder))}'


def _told_so_far(options: Options, replaced: str) -> str:
    """Return the options that differ from their defaults, but for those that are told now, as arguments."""
    usual = {item.name: item.default for item in walk_options(Options())}
    now = {
        '--camera-height': 'camera_height',
        '--distance': 'scale.distance',
        '--hfov-deg': 'lens.',
        '--method': 'method',
    }
    left_out = now.get(replaced.partition(' ')[0], replaced.removeprefix('-p ').partition(':=')[0] or '-')
    told = [
        f'{_argument(item.name, item.default)} '
        for item in walk_options(options)
        if item.default != usual[item.name] and not item.name.startswith(left_out)
    ]
    return ''.join(told)


def _argument(name: str, value: object) -> str:
    if name in FLAGS:
        return f'{FLAGS[name]} {value:g}' if isinstance(value, float) else f'{FLAGS[name]} {value}'
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return f'-p {shlex.quote(f"{name}:={text}")}'
