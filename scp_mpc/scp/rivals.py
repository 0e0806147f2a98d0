"""When to give up a rival: a run of the loop that is to beat a plan which is there already."""

from scp_mpc.scp.candidates import Passing, same_way
from scp_mpc.scp.certificate import Nominal
from scp_mpc.scp.iterate import NEGLIGIBLE
from scp_mpc.scp.plan import Result
from scp_mpc.scp.transcription import Transcription

_PATIENCE = 3  # iterations before a rival is given up
_FAR = 1.1  # share of the goal's merit above which it is
_ALIKE = 0.01  # relative difference of cost of plans that may become the same


def is_vain(at: Transcription, iterations: int, trial: Nominal, goal: Result) -> bool:
    """Whether a run is too far above the goal, or about to end just there.

    The cost falls from one iteration to the next, by less each time; where Newton's steps raise it,
    that is far less than what counts here.
    """
    cost, other = trial.cost, goal.iterate
    if goal.status.ok and iterations >= _PATIENCE and cost > _FAR * goal.merit:
        return True
    if not len(trial.force) or abs(cost - goal.cost) > _ALIKE * goal.cost:
        return False
    mine = Passing(at.path(trial.y)[1:], trial.pairs.table(trial.force) > NEGLIGIBLE)
    there = at.nodes.positions(other.states, other.inputs)
    return same_way(at.step, mine, Passing(there, other.touched[: at.step.count]))
