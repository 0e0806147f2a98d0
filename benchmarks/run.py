"""Run the benchmarks and write tables, figures and numbers.

    python benchmarks/run.py --out benchmarks/results            all of them
    python benchmarks/run.py --out out/bench --only scaling --steps 50

horizon     (a, c, e) a control step at N = 8 and N = 30, and among 5 and 12 obstacles, against
            IPOPT, Fatrop, CasADi's SQP with three QP solvers, SLSQP, and scp_mpc with each of its
            own QP solvers
scaling     (b) closed loops over horizons 5 to 200 and 1 to 50 obstacles, with fitted exponents
deadlines   closed loops among 12 obstacles with a deadline, and how late their steps end
optimality  (d) plan costs against the best of 24 starts of IPOPT
programs    QP solvers on recorded programs
robots      closed loops of all robots, relative to the double integrator among 5 obstacles
"""

import argparse
from pathlib import Path

from scp_mpc.comparison import BENCHMARKS, run

if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--only", choices=BENCHMARKS, nargs="+", default=list(BENCHMARKS))
    parser.add_argument("--steps", type=int, default=200, help="control steps of each closed loop")
    parser.add_argument("--seed", type=int, default=0, help="of turns and random starts")
    arguments = parser.parse_args()
    for name in arguments.only:
        run(name, arguments.out, arguments.steps, arguments.seed, print)
