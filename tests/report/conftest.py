"""What a report is about, of every kind, built by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from autocalib_ros.config import Options
from autocalib_ros.report.page import write_report
from autocalib_ros.report.scene import ReportScene, SolutionSnapshot
from synthetic_results import full_result, grey_road, junction_evidence, lens_result, refusal

MOMENTS = (
    SolutionSnapshot(10.0, code='too_few_tracks'),
    SolutionSnapshot(20.0, 146.0, 4.0, 39.0, 0.5),
    SolutionSnapshot(60.0, 140.0, 1.5, 40.0, 0.2),
)


@pytest.fixture(scope='session')
def full() -> ReportScene:
    """Return a calibration with everything that a report can show."""
    evidence = junction_evidence()
    return ReportScene(
        result=full_result(evidence),
        evidence=evidence,
        background=grey_road(),
        accepted_at_s=20.0,
        options=Options(camera_height=8.0),
        source='clip <1>.mp4',
        moments=MOMENTS,
    )


@pytest.fixture(scope='session')
def refused(full: ReportScene) -> ReportScene:
    """Return a refusal of a recording with a long name."""
    return replace(
        full,
        result=refusal(full.evidence),
        accepted_at_s=None,
        moments=MOMENTS[:1],
        source='a/' + 200 * 'very_long_name',
    )


@pytest.fixture(scope='session')
def lens_only(full: ReportScene) -> ReportScene:
    """Return a lens without a ground plane, without a picture of the road."""
    return replace(full, result=lens_result(full.result), background=None)


@pytest.fixture(scope='session')
def written(request, tmp_path_factory) -> Callable[[str], Path]:
    """Return a function that gives the page of one of the kinds above, written once: it takes seconds."""
    pages: dict[str, Path] = {}

    def page(kind: str) -> Path:
        if kind not in pages:
            pages[kind] = tmp_path_factory.mktemp(kind) / 'report.html'
            write_report(pages[kind], request.getfixturevalue(kind))
        return pages[kind]

    return page
