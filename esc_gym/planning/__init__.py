"""Looking ahead on the batch engine: what actions are worth, by driving copies of the scene on.

    planner = LookAhead()
    values = planner.values(envs)  # [num_envs, A]
    envs.step(planner.actions(envs))

LookAhead tries everything in the first steps, TreeSearch what is promising, farther; CrossEntropy
plans continuous actions.

With ``knows="all"`` the copies hold the simulator's whole state: what the other drivers want, and
the random numbers still to be drawn. That is what a driver could reach who knew all: a reference
and a teacher, and no driver that one could put on a road. With ``knows="observed"`` they hold what
can be seen, and what is not seen is guessed: see ``guess``.
"""

from esc_gym.planning.cross_entropy import CrossEntropy
from esc_gym.planning.guesses import guess
from esc_gym.planning.lookahead import LookAhead
from esc_gym.planning.planner import Knowledge, MetaPlanner, Planner
from esc_gym.planning.rollouts import OWN, best, meta_actions, rollouts
from esc_gym.planning.rules import idm_actions
from esc_gym.planning.survival import survivable
from esc_gym.planning.tree import TreeSearch

__all__ = [
    "OWN", "CrossEntropy", "Knowledge", "LookAhead", "MetaPlanner", "Planner", "TreeSearch", "best",
    "guess", "idm_actions", "meta_actions", "rollouts", "survivable",
]  # fmt: skip
