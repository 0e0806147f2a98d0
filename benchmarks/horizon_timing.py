"""Time a control step at N = 8 and N = 30 against IPOPT and the report's SLSQP.

    python benchmarks/horizon_timing.py
    python benchmarks/horizon_timing.py --steps 600 --out out/timing

The report's scenarios 2 and 1, run once in closed loop; then all solve the recorded steps from the
same guess, in one thread, in turns of shuffled order. Takes about a minute. Writes
horizon_timing.md, horizon_timing.json and horizon_timing.png.

scp_mpc               default settings: other ways past the obstacle are tried
scp_mpc, one start    from the guess alone, as the others
ipopt                 interior points, exact derivatives (CasADi)
slsqp                 the report's method (SciPy); at N = 30 on every k-th step only
"""

import argparse
from functools import partial
from pathlib import Path

from scp_mpc import Problem, Settings
from scp_mpc.comparison import Ipopt, Ours, Slsqp, horizon_timing


def solvers(problem: Problem) -> horizon_timing.Builders:
    """Who takes part; `horizon_timing.everyone` has more."""
    return {
        "scp_mpc": partial(Ours, problem, multi_start=True),
        "scp_mpc, one start": partial(Ours, problem, Settings(multi_start=False)),
        "ipopt": partial(Ipopt, problem),
        "slsqp": partial(Slsqp, problem),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    results = Path(__file__).parent / "results"
    parser.add_argument("--steps", type=int, default=200, help="control steps per horizon")
    parser.add_argument("--out", type=Path, default=results, help="folder for the results")
    parser.add_argument("--seed", type=int, default=0, help="of the solvers' turns")
    arguments = parser.parse_args()
    horizon_timing.main(
        arguments.out / f"{horizon_timing.NAME}.json",
        arguments.out,
        arguments.steps,
        arguments.seed,
        echo=print,
        solvers=solvers,
    )
