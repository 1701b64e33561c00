"""Tree search, beside exhaustive look-ahead, and its tree beside brute force."""

from itertools import pairwise, product

import numpy as np
import pytest

from esc_gym.planning import LookAhead, TreeSearch
from esc_gym.planning.tree import Tree
from tests.esc_gym.planning.scenes import IDS, driven, restless


@pytest.mark.parametrize("knows", ["all", "observed"])
@pytest.mark.parametrize("env_id", IDS)
def test_one_expansion_is_a_look_ahead(env_id, knows):
    envs, _ = driven(env_id)
    shared = {"horizon": 5, "knows": knows, "policy": restless}
    np.testing.assert_array_equal(
        TreeSearch(expansions=1, **shared).values(envs), LookAhead(free=1, **shared).values(envs)
    )


@pytest.mark.parametrize("env_id", IDS)
def test_who_has_time_has_tried_everything(env_id):
    envs, _ = driven(env_id)
    everything = LookAhead(horizon=3, free=3).values(envs)
    np.testing.assert_array_equal(TreeSearch(horizon=3, expansions=99).values(envs), everything)
    assert TreeSearch(horizon=1, expansions=9).values(envs).shape == everything.shape


def test_it_only_gets_better_leaves_the_batch_alone_and_needs_no_company():
    envs, _ = driven(IDS[0], 3)
    before = envs.snapshot()
    found = [TreeSearch(horizon=6, expansions=count).values(envs) for count in (1, 4, 16)]
    assert envs.snapshot() == before
    for less, more in pairwise(found):
        assert (more >= less).all()
    assert (found[-1] > found[0]).any()
    alone = TreeSearch(horizon=6, expansions=16).values(envs, [2])
    np.testing.assert_array_equal(alone[0], found[-1][2])
    actions = TreeSearch(horizon=6, expansions=16).actions(envs)
    assert (found[-1][range(3), actions] == found[-1].max(axis=1)).all()


def test_without_time_it_looks_once():
    envs, _ = driven(IDS[0])
    hurried = TreeSearch(horizon=5, milliseconds=0).values(envs)
    np.testing.assert_array_equal(hurried, TreeSearch(horizon=5, expansions=1).values(envs))


def worth(sequence):
    """A maze: the way to the best return begins badly. Never chosen: it ends in zeros."""
    whole = (*sequence, *[0] * (4 - len(sequence)))
    return float(np.dot(whole, [-3, 1, 2, 4])) + 0.1 * whole[0] * whole[3]


def test_a_tree_finds_the_best_of_all_and_tries_nothing_twice():
    tree, tried = Tree(count=3, horizon=4, exploration=0.5), []
    while () not in tree.closed:
        leaf = tree.leaf()
        tried.append(leaf)
        tree.expand(leaf, [worth((*leaf, action)) for action in range(3)])
    assert len(tried) == len(set(tried)) == 1 + 3 + 9 + 27
    for action, value in enumerate(tree.values()):
        assert value == max(worth((action, *rest)) for rest in product(range(3), repeat=3))


def test_a_tree_grows_where_it_is_promising():
    tree = Tree(count=2, horizon=12, exploration=0.1)
    for _ in range(20):
        leaf = tree.leaf()
        tree.expand(leaf, [float(sum((*leaf, action))) for action in range(2)])
    assert tree.visits[1,] > 15
    assert max(map(len, tree.best)) == 12


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"expansions": 0}, "expansions: expected at least 1, got 0"),
        ({"exploration": -1}, "exploration: expected at least 0, got -1"),
        ({"milliseconds": -1}, "milliseconds: expected at least 0, got -1"),
        ({"horizon": 0}, "horizon: expected at least 1, got 0"),
    ],
)
def test_bad_settings_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        TreeSearch(**arguments)
