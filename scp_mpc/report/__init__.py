"""Report: the tables, figures and the animation of closed-loop runs."""

from scp_mpc.report.animation import write_animation
from scp_mpc.report.figures import FIGURES, write_figures
from scp_mpc.report.summary import summarise, summarise_all, write_summary
from scp_mpc.report.table import COLUMNS, markdown_table

__all__ = [
    "COLUMNS",
    "FIGURES",
    "markdown_table",
    "summarise",
    "summarise_all",
    "write_animation",
    "write_figures",
    "write_summary",
]
