"""Episodes of training that begin shortly before a collision of an earlier one."""

from __future__ import annotations

import numpy as np
import pytest

from esc_agents.driving import crash_replay
from esc_agents.driving.batch import BatchVecEnv
from esc_agents.driving.crash_replay import BEYOND, EVERY, LEAST
from esc_agents.driving.vectorised import vectorise
from esc_agents.errors import UserError
from esc_agents.training.train import train
from tests.esc_agents.tiny import PPO, tiny

FASTER, IDLE = 3, 1
CRASHING = {"vehicles_count": 20, "duration": 30, "lanes_count": 1, "policy_frequency": 5}


def config(share=0.5, **changes):
    values = {"vec": "batch", "n_envs": 3, "env_config": CRASHING,
              "ppo": {**PPO, "crash_replay": share}, **changes}  # fmt: skip
    return tiny(**values)


def replaying(share=0.5, **changes):
    run = config(share, **{"steps": 1, **changes})
    envs = BatchVecEnv(run, run.n_envs)
    envs.seed(3)
    return envs, envs.reset()


def episodes(envs, observation, steps, action=FASTER):
    """(whether a replay, what was seen [steps, ...], last info, whether in a collision) of each."""
    seen = [[part] for part in observation["vehicles"]]
    found, begun = [], envs.replay.replaying
    for _ in range(steps):
        observation, _, dones, infos = envs.step(np.full(envs.num_envs, action))
        for e in range(envs.num_envs):
            if dones[e]:
                found.append((begun[e], seen[e], infos[e], infos[e]["crashed"]))
                seen[e] = []
            seen[e].append(observation["vehicles"][e])
        begun = envs.replay.replaying
    return found


def test_it_begins_where_an_earlier_episode_was_before_its_collision():
    found = episodes(*replaying(), 300)
    whole = [seen for again, seen, _, crashed in found if not again and crashed]
    again = [seen for again, seen, _, _ in found if again]
    assert len(whole) > 10
    assert len(again) > 10
    begins = []
    for first, *_ in again:
        places = [len(seen) - i for seen in whole for i, one in enumerate(seen)
                  if np.array_equal(one, first)]  # fmt: skip
        assert places, "nothing like it was seen in an episode that ended in a collision"
        begins.append(min(places))
    assert min(begins) >= LEAST
    assert max(begins) > LEAST
    assert max(begins) < LEAST + EVERY * crash_replay.COPIES


def test_the_same_actions_lead_to_the_same_collision():
    """Ahead of the ego nothing is drawn in a step here: always FASTER it meets what it met."""
    for again, seen, info, crashed in episodes(*replaying(), 300):
        if again:
            assert crashed
            assert LEAST <= len(seen) < LEAST + EVERY * crash_replay.COPIES
            assert not info["TimeLimit.truncated"]


def test_who_brakes_comes_through_and_is_cut_off():
    """As if by a time limit, so that PPO goes on counting with what would have come."""
    envs, observation = replaying(share=1.0)
    episodes(envs, observation, 60)
    braked = []
    for _ in range(40):
        left = envs.replay._left.copy()
        _, _, dones, infos = envs.step(np.full(3, 4))
        braked += [infos[e] for e in np.flatnonzero(dones & (left == 1)) if not infos[e]["crashed"]]
    assert braked
    assert all(info["TimeLimit.truncated"] for info in braked)
    assert all("terminal_observation" in info for info in braked)


def test_it_ends_some_steps_after_the_collisions_moment():
    envs, _ = replaying(share=1.0)
    replay = envs.replay
    replay.after_step(np.zeros(3, bool), np.ones(3))
    kept = envs.envs.keep([0])
    replay._crashes.append((5, kept))
    assert replay.begin(np.array([True, False, True])).tolist() == [True, False, True]
    ends = [replay.after_step(np.zeros(3, bool), np.ones(3)).tolist() for _ in range(5 + BEYOND)]
    assert ends[:-1] == [[False] * 3] * (5 + BEYOND - 1)
    assert ends[-1] == [True, False, True]


def test_statistics_are_of_whole_episodes():
    found = episodes(*replaying(), 200)
    assert {again for again, *_ in found} == {True, False}
    for again, seen, info, _ in found:
        assert ("episode" in info) != again
        if not again:
            assert info["episode"]["l"] == len(seen)


def test_collisions_of_replays_are_not_replayed():
    envs, observation = replaying(share=1.0)
    found = episodes(envs, observation, 300)
    whole = [seen for again, seen, _, crashed in found if not again and crashed]
    assert len(found) > 3 * len(whole)
    assert len(envs.replay._crashes) <= len(whole)


def test_a_share_of_all_episodes():
    found = episodes(*replaying(share=0.3), 3000)
    assert np.mean([again for again, *_ in found]) == pytest.approx(0.3, abs=0.06)


def test_it_waits_for_the_second_half():
    envs, observation = replaying(steps=600)
    first, second = (episodes(envs, observation, 100) for _ in range(2))
    assert not any(again for again, *_ in first[:-3])
    assert any(again for again, *_ in second)


def test_without_collisions_there_are_none():
    envs, observation = replaying(env_config={"vehicles_count": 0, "duration": 5})
    assert not any(again for again, *_ in episodes(envs, observation, 30, IDLE))


def test_evaluations_and_other_runs_have_none():
    assert BatchVecEnv(config(), 2, evaluation=True).replay is None
    assert BatchVecEnv(config(share=0.0), 2).replay is None


def test_a_state_goes_to_another_batch():
    one, observation = replaying()
    episodes(one, observation, 50)
    two = BatchVecEnv(config(steps=1), 3)
    two.restore(one.state())
    mine, others = (episodes(envs, envs.envs._observation(envs.envs.engine.now), 100)
                    for envs in (one, two))  # fmt: skip
    assert len(mine) == len(others)
    for (again, seen, _, crashed), (there, wanted, _, bad) in zip(mine, others, strict=True):
        assert (again, crashed) == (there, bad)
        np.testing.assert_array_equal(seen, wanted)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"vec": "dummy"}, "vec is dummy, where auto would take it"),
        ({"vec": "auto", "observation": {"accelerate": False}}, "observation.accelerate is false"),
    ],
)
def test_it_needs_the_batch_engine(changes, reason, tmp_path):
    run = config(**changes)
    with pytest.raises(UserError, match=f"expected 0 without the batch engine, got 0.5: {reason}"):
        train(run.model_copy(update={"run_dir": tmp_path / "run"}))
    assert not (tmp_path / "run").exists()
    vectorise(run, 2, evaluation=True)


def test_a_state_of_a_run_without():
    for mine, other in ((config(), config(share=0.0)), (config(share=0.0), config())):
        envs, others = BatchVecEnv(mine, 3), BatchVecEnv(other, 3)
        for each in (envs, others):
            each.reset()
        with pytest.raises(ValueError, match=r"the same ppo\.crash_replay"):
            envs.restore(others.state())


def test_what_is_told_of_a_beginning_and_of_success():
    run = tiny("exit-v0", vec="batch", n_envs=8, steps=1, ppo={**PPO, "crash_replay": 1.0})
    envs = BatchVecEnv(run, 8)
    envs.seed(3)
    envs.reset()
    rng, told = np.random.default_rng(0), set()
    for _ in range(150):
        replayed = envs.replay.replaying
        *_, dones, infos = envs.step(rng.integers(0, 5, 8))
        told |= {
            (bool(again), "is_success" in infos[e]) for e, again in enumerate(replayed) if dones[e]
        }
        for e in np.flatnonzero(dones & envs.replay.replaying):
            assert envs.reset_infos[e]["set"]["count"] == envs.envs.counts[e]
    assert told == {(False, True), (True, False)}
