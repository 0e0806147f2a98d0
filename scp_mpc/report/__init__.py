"""Report: the tables, figures and the animation of closed-loop runs."""

from scp_mpc.report.animation import write_animation
from scp_mpc.report.canvas import save
from scp_mpc.report.coverage_figure import coverage_figure, coverage_numbers, coverage_table
from scp_mpc.report.encounters import centre_distances, no_go_clearances
from scp_mpc.report.figures import FIGURES, write_figures
from scp_mpc.report.history_figure import history_figure
from scp_mpc.report.replay_picture import replay_figure, write_replay_animation
from scp_mpc.report.replay_summary import replay_table, summarise_replay
from scp_mpc.report.summary import summarise, table_cells, write_summary

__all__ = [
    "FIGURES",
    "centre_distances",
    "coverage_figure",
    "coverage_numbers",
    "coverage_table",
    "history_figure",
    "no_go_clearances",
    "replay_figure",
    "replay_table",
    "save",
    "summarise",
    "summarise_replay",
    "table_cells",
    "write_animation",
    "write_figures",
    "write_replay_animation",
    "write_summary",
]
