"""The two halves of a step around the sub-steps: what was decided, and what has come of it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from esc_gym.fastsim.cache import cached
from esc_gym.fastsim.kernel import COMMAND, EGO, FRAME, scene_of
from esc_gym.fastsim.numerics import compiled
from esc_gym.fastsim.records import MDP, NOTHING
from esc_gym.vector.observe import Output, Spec, observe
from esc_gym.vector.state import ROAD, SHUFFLE

TERMINATED, TRUNCATED = range(2)
# Values of ``over``: going on, ended, to be reset at once.
RUNNING, ENDED, RESET = range(3)


class Told(NamedTuple):
    """What ``info`` says of E environments: speed [E], crashed [E], rewards [E, K] by name."""

    speed: np.ndarray
    crashed: np.ndarray
    rewards: np.ndarray


@compiled
def speed_index(speed, target_speeds):
    """``MDPVehicle.speed_to_index``."""
    last = len(target_speeds) - 1
    x = (speed - target_speeds[0]) / (target_speeds[last] - target_speeds[0])
    return np.int64(min(max(np.rint(x * last), 0.0), np.float64(last)))


@cached
def decide(
    vehicles, counts, heads, progress, actions, commands, speed_steps, target_speeds, controls,
    speed_range, first, last, frames
):  # fmt: skip
    """Begin a step: take the actions, and leave alone the environments that are to be reset.

    actions [E]: numbers of meta-actions; commands, speed_steps [A]: what each asks for.
    controls [E, 2]: steering and acceleration of an ego that takes no meta-actions; speed_range:
    what its first action limits it to, inf and -inf for nothing.
    """
    for e in range(first, last):
        progress[e] = 0
        progress[e, COMMAND] = NOTHING
        if heads[e].over:
            progress[e, FRAME] = frames
            continue
        me = vehicles[e, counts[e, EGO]]
        if me.kind != MDP:
            me.steering, me.acceleration = controls[e, 0], controls[e, 1]
            if speed_range[0] <= speed_range[1]:
                me.min_speed, me.max_speed = speed_range[0], speed_range[1]
            continue
        action = actions[e]
        progress[e, COMMAND] = commands[action]
        if speed_steps[action] != 0:
            index = speed_index(me.speed, target_speeds) + speed_steps[action]
            index = min(max(index, 0), len(target_speeds) - 1)
            me.target_speed = target_speeds[index]


@compiled
def tell(s, ego, e, head, spec, generators, ids, out, told):
    """The observation of environment ``e``, and what info says of it."""
    head.next_id = observe(s, ego, e, spec, generators[e, SHUFFLE], ids[e], head.next_id, out)
    told.speed[e], told.crashed[e] = s.vehicles[ego].speed, s.vehicles[ego].crashed


def settling(reset: Any, judge: Any) -> Any:
    """End a step: reward, ends, observation, and the resets that are due.

    reset(s, ego, head, generator, constants): makes a new scene of ``template``'s vehicles.
    judge(s, ego, head, constants, parts): (reward, terminated, truncated), and the rewards by name.
    period: of a policy step [s]; 0: only those that are to RESET.
    limit: policy steps until an episode is cut short, 0 for none. same_step: reset at once, what
    the last step gave is in ``final``; otherwise it is done with the next step.
    """

    @compiled
    def settle_all(
        vehicles, counts, routes, lanes, lon, lat, seats, ranks, ranked, link_start, link_lane,
        link_offset, exits, poses, widths, samples, numerics,
        ids, heads, generators, template, constants,
        reach, rules, columns, center, half, ego_columns, ego_center, ego_half, virtual,
        out_ego, out_vehicles, out_mask, out_ids, out_counts, speed, crashed, parts,
        end_ego, end_vehicles, end_mask, end_ids, end_counts, end_speed, end_crashed, end_parts,
        rewards, ends, first, last, frames, period, limit, same_step
    ):  # fmt: skip
        spec = Spec(reach, rules, columns, center, half, ego_columns, ego_center, ego_half, virtual)
        out, told = (
            Output(out_ego, out_vehicles, out_mask, out_ids, out_counts),
            Told(speed, crashed, parts),
        )
        final = Output(end_ego, end_vehicles, end_mask, end_ids, end_counts)
        final_told = Told(end_speed, end_crashed, end_parts)
        for e in range(first, last):
            s = scene_of(
                e, vehicles, counts, routes, lanes, lon, lat, seats, ranks, ranked, link_start,
                link_lane, link_offset, exits, poses, widths, samples, numerics,
            )  # fmt: skip
            head, ego = heads[e], counts[e, EGO]
            begin = head.over == RESET or (period > 0.0 and head.over != 0)
            if not begin and period == 0.0:
                continue
            rewards[e], ends[e, TERMINATED], ends[e, TRUNCATED] = 0.0, 0, 0
            if not begin:
                head.time += period
                head.steps += frames
                head.elapsed += 1
                reward, terminated, truncated = judge(s, ego, head, constants, told.rewards[e])
                truncated = truncated or (limit > 0 and head.elapsed >= limit)
                rewards[e] = reward
                ends[e, TERMINATED], ends[e, TRUNCATED] = terminated, truncated
                if terminated or truncated:
                    begin = same_step
                    head.over = RUNNING if same_step else ENDED
                if begin:
                    tell(s, ego, e, head, spec, generators, ids, final, final_told)
                    final_told.rewards[e] = told.rewards[e]
            if begin:
                head.time = 0.0
                head.steps = head.elapsed = head.over = head.next_id = 0
                ids[e] = -1
                s.vehicles[:] = template
                reset(s, ego, head, generators[e, ROAD], constants)
                judge(s, ego, head, constants, told.rewards[e])
            tell(s, ego, e, head, spec, generators, ids, out, told)

    return settle_all
