"""A million control steps in random worlds with faults injected; what must not happen is counted.

    python benchmarks/soak.py --out benchmarks/results/soak

It may be stopped at any time: the same command goes on where it was, and ends with the table.
"""

import argparse
from pathlib import Path

from scp_mpc.comparison import run_soak

if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for chunks and results")
    parser.add_argument("--steps", type=int, default=1_000_000, help="control steps in all")
    parser.add_argument("--seed", type=int, default=0, help="of the worlds")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--chunk", type=int, default=10_000, help="control steps per chunk")
    arguments = parser.parse_args()
    total = run_soak(**vars(arguments), echo=print)
    raise SystemExit(any(total[what] for what in ("invalid", "lies", "escaped", "traces")))
