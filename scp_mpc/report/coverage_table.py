"""The table of a coverage: one row for each lead time."""

from dataclasses import asdict
from typing import Any

from scp_mpc.provenance import provenance
from scp_mpc.simulation.coverage import Coverage


def coverage_table(coverage: Coverage) -> list[list[str]]:
    """Return header and rows, ready to be printed; shares with their standard error."""
    header = [
        "Lead\n[s]",
        "Samples",
        "People",
        "Mean\nerror\n[m]",
        "RMS\nerror\n[m]",
        "Pre-\ndicted\n[m]",
    ]
    header += ["NEES", *(f"within\n{100 * level:g} %\n[%]" for level in coverage.levels)]
    rows = [
        [
            f"{row.lead:.1f}",
            str(row.samples),
            str(row.people),
            f"{row.mean_error:.2f}",
            f"{row.rms_error:.2f}",
            f"{row.rms_predicted:.2f}",
            f"{row.nees:.2f}",
            *(
                f"{100 * share:.1f}±{100 * error:.1f}"
                for share, error in zip(row.shares, row.errors, strict=True)
            ),
        ]
        for row in coverage.leads
    ]
    return [header, *rows]


def coverage_numbers(coverage: Coverage) -> dict[str, Any]:
    """Return everything, ready for JSON."""
    return {**asdict(coverage), "provenance": provenance()}
