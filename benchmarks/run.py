"""Run the benchmarks and write tables, figures and numbers.

    python benchmarks/run.py --out benchmarks/results            all of them
    python benchmarks/run.py --out out/bench --only scaling --steps 50

horizon     a control step at N = 8 and N = 30, and among 5 and 12 obstacles, against IPOPT, Fatrop,
            CasADi's SQP with three QP solvers, SLSQP, and scp_mpc with each of its own QP solvers
scaling     closed loops over horizons 5 to 200 and 1 to 50 obstacles, with fitted exponents
deadlines   closed loops among 12 obstacles with a deadline, and how late their steps end
optimality  plan costs against the best of 24 starts of IPOPT
programs    QP solvers on recorded programs
robots      closed loops of all robots, relative to the double integrator among 5 obstacles
user_models one robot as a plain function, a CasADi expression and built in
scenarios   the report's four scenarios, 600 steps each
race        closed loops of scp_mpc on OSQP and in C, acados, Fatrop and IPOPT, in turns on one
            core; `python -m benchmarks.peers.acados` installs acados for it
ablation    what the parts of the loop and its solver's options are worth
"""

import argparse
from collections.abc import Callable
from pathlib import Path

from benchmarks import (
    ablation,
    deadlines,
    horizon_timing,
    optimality,
    programs,
    race,
    robots,
    scaling,
    scenarios,
    user_models,
)
from benchmarks.processes import in_one_thread
from benchmarks.tables import write

BENCHMARKS = (
    "horizon",
    "scaling",
    "deadlines",
    "optimality",
    "programs",
    "robots",
    "user_models",
    "scenarios",
    "race",
    "ablation",
)


def run(name: str, out: Path, steps: int, seed: int, echo: Callable[[str], object]) -> None:
    """Run one benchmark in a process of one thread and write its files into a folder.

    Args:
        name: One of `BENCHMARKS`.
        out: The folder.
        steps: Control steps of each closed loop.
        seed: Of turns and random starts.
        echo: Takes the Markdown table.
    """
    if name == "horizon":
        horizon_timing.main(out, steps, seed, echo=echo, crowds=True)
    elif name == "race":
        race.main(out, steps, seed, echo)
    elif name == "scaling":
        found = in_one_thread(scaling.rows, steps)
        fitted = scaling.exponents(found)
        text = scaling.markdown(found) + (
            f"\n\nMedian ~ N^{fitted['a']:.2f} (one obstacle, N >= 30, one start), "
            f"~ M^{fitted['b']:.2f} (N = 30, one start)."
        )
        content = {"rows": found, "exponents": fitted}
        write(out, scaling.NAME, text, content, scaling.figure(found, fitted), echo)
    elif name == "optimality":
        found = in_one_thread(optimality.rows, steps, optimality.STARTS, seed)
        write(out, optimality.NAME, optimality.markdown(found), {"rows": found}, echo=echo)
    elif name == "scenarios":
        found = in_one_thread(scenarios.rows)
        write(out, scenarios.NAME, scenarios.markdown(found), {"rows": found}, echo=echo)
    elif name in ("programs", "ablation", "user_models"):
        plain = {"programs": programs, "ablation": ablation, "user_models": user_models}[name]
        found = in_one_thread(plain.rows, steps)
        write(out, plain.NAME, plain.markdown(found), {"rows": found}, echo=echo)
    else:
        which = {"deadlines": deadlines, "robots": robots}[name]
        found = in_one_thread(which.rows, steps)
        write(out, which.NAME, which.markdown(found), {"rows": found}, which.figure(found), echo)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--only", choices=BENCHMARKS, nargs="+", default=list(BENCHMARKS))
    parser.add_argument("--steps", type=int, default=200, help="control steps of each closed loop")
    parser.add_argument("--seed", type=int, default=0, help="of turns and random starts")
    arguments = parser.parse_args()
    for each in arguments.only:
        run(each, arguments.out, arguments.steps, arguments.seed, print)
