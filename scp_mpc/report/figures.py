"""Counterparts of the report's figures 1 to 14: which quantity of which scenario."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from scp_mpc.report.canvas import save
from scp_mpc.report.time_series import (
    duration_figure,
    input_figure,
    size_figure,
    velocity_figure,
)
from scp_mpc.report.trajectory import trajectory_figure
from scp_mpc.simulation.closed_loop import ClosedLoop


@dataclass(frozen=True)
class ReportFigure:
    """One figure of the report.

    Attributes:
        number: Its number there.
        subject: What it shows, as in the file's name.
        scenario: Name of the scenario.
        draw: Draws it from a run.
    """

    number: int
    subject: str
    scenario: str
    draw: Callable[[ClosedLoop], Figure]

    @property
    def file_name(self) -> str:
        """Name of the file, without directory."""
        return f"fig{self.number:02d}_{self.subject}_{self.scenario}.png"


FIGURES: tuple[ReportFigure, ...] = (
    ReportFigure(1, "trajectory", "scenario-1", trajectory_figure),
    ReportFigure(2, "s", "scenario-1", size_figure),
    ReportFigure(3, "inputs", "scenario-1", input_figure),
    ReportFigure(4, "velocities", "scenario-1", velocity_figure),
    ReportFigure(5, "time", "scenario-1", duration_figure),
    ReportFigure(6, "time", "scenario-2", duration_figure),
    ReportFigure(7, "velocities", "scenario-2", velocity_figure),
    ReportFigure(8, "trajectory", "scenario-2", trajectory_figure),
    ReportFigure(9, "inputs", "scenario-2", input_figure),
    ReportFigure(10, "trajectory", "scenario-3", trajectory_figure),
    ReportFigure(11, "trajectory", "scenario-4", trajectory_figure),
    ReportFigure(12, "inputs", "scenario-4", input_figure),
    ReportFigure(13, "s", "scenario-4", size_figure),
    ReportFigure(14, "velocities", "scenario-4", velocity_figure),
)


def write_figures(runs: Sequence[ClosedLoop], directory: Path) -> list[Path]:
    """Write the figures of those scenarios that were run and return their files."""
    by_name = {run.scenario.name: run for run in runs}
    return [
        save(figure.draw(by_name[figure.scenario]), directory / figure.file_name)
        for figure in FIGURES
        if figure.scenario in by_name
    ]
