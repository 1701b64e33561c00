from itertools import product

import numpy as np
import pytest

from esc_gym.planning import rollouts, survivable
from esc_gym.vector.state import RUNNING
from tests.esc_gym.vector.stock import batch

COUNT, LEFT = 24, 3  # environments, and steps to the end of their episodes
CROWDED = {
    "duration": 1 + LEFT, "vehicles_density": 2.5, "ego_spacing": 0.5, "vehicles_count": 30,
}  # fmt: skip


@pytest.fixture
def crowded():
    """Environments after a step, some of whose egos have crashed, or will whatever they do."""
    envs = batch("esc_gym/highway-fast-v0", COUNT, CROWDED)
    envs.reset(seed=0)
    envs.step(np.ones(COUNT, int))
    yield envs
    envs.close()


def test_who_can_survive_is_who_does_by_some_sequence(crowded):
    over = crowded.engine.state.heads["over"] != RUNNING
    running = np.flatnonzero(~over)
    assert 0 < len(running) < COUNT
    plans = np.array(list(product(range(5), repeat=LEFT)))
    dear = 1e6
    by_any = [
        bool((rollouts(crowded, [e] * len(plans), plans, crash_cost=dear) > -dear / 2).any())
        for e in running
    ]
    assert {*by_any} == {True, False}
    before = crowded.engine.state.vehicles.copy()
    assert [survivable(crowded, int(e)) for e in running] == by_any
    for e, possible in zip(running, by_any, strict=True):
        assert possible or not survivable(crowded, int(e), scenes=4)
    assert np.array_equal(crowded.engine.state.vehicles, before)
    with pytest.raises(ValueError, match=r"environment \d+: its episode has ended"):
        survivable(crowded, int(np.flatnonzero(over)[0]))
