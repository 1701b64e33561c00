"""A road network as arrays, read once per network and watched for changes."""

from __future__ import annotations

import struct
from operator import attrgetter
from typing import Any

import numpy as np

from esc_gym.fastsim.known import is_known_network, lane_kind
from esc_gym.fastsim.records import (
    CIRCULAR,
    LANE,
    LANE_FLOATS,
    LANE_INTS,
    POSE_COLUMNS,
    SINE,
    SPLINE,
    STRAIGHT,
)

LaneIndex = tuple[str, str, int]
_RECORD = struct.Struct(f"={len(LANE_FLOATS)}d{len(LANE_INTS)}q")
NOT_STRAIGHT, NOT_SINE, NOT_CIRCULAR, NOT_SPLINE = ((0,) * fields for fields in (7, 3, 5, 4))
_RULES = attrgetter("length", "width", "speed_limit", "forbidden", "priority")


_SHAPES = {
    STRAIGHT: attrgetter("heading", "start", "direction", "direction_lateral"),
    SINE: attrgetter(
        "heading", "start", "direction", "direction_lateral", "amplitude", "pulsation", "phase"
    ),
    CIRCULAR: attrgetter("radius", "start_phase", "direction", "center"),
}
_NUMBER = struct.Struct("=d")


def _content(lane: Any) -> tuple[Any, ...] | None:
    """All of a lane that its record depends on; None of a spline, which is long."""
    kind = lane_kind(type(lane))
    if kind not in _SHAPES:
        return None
    shape = [
        (value.dtype.char, value.tobytes()) if type(value) is np.ndarray else _NUMBER.pack(value)
        for value in _SHAPES[kind](lane)
    ]
    return type(lane), _RULES(lane), shape


class Unknown(Exception):
    """Something that the kernels do not know; says what, and stock code runs instead."""


class Network:
    """``RoadNetwork`` for the kernels.

    indexes: lane index of each of the L lanes; numbers: the other way round; records: LANE [L].
    """

    def __init__(self, network: Any) -> None:
        if not is_known_network(type(network)):
            raise Unknown(f"road network {type(network).__name__}")
        self.network = network
        self.indexes: list[LaneIndex] = list(network.lanes_dict())
        self.lanes: list[Any] = network.lanes_list()
        self.numbers = {index: number for number, index in enumerate(self.indexes)}
        self.most_lanes = max((index[2] + 1 for index in self.indexes), default=0)
        self.all_limited = all(lane.speed_limit is not None for lane in self.lanes)
        self._rules, self._contents = self._read_rules(), list(map(_content, self.lanes))
        self.records: Any = np.zeros(len(self.lanes), LANE)
        self._poses: list[tuple[float, ...]] = []
        self._widths: list[float] = []
        self._exits: list[int] = []
        for number, (index, lane) in enumerate(zip(self.indexes, self.lanes, strict=True)):
            record = self._record(index, lane)
            _RECORD.pack_into(self.records, number * LANE.itemsize, *record)
        self.poses = np.array(self._poses, float).reshape(-1, len(POSE_COLUMNS))
        self.widths = np.array(self._widths, float)
        self.exits = np.array(self._exits, np.int64)
        self._links: dict[bool, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

    def takes_over(self, network: Any) -> bool:
        """Has another road network the same lanes, to the last bit? Then this is now its reading.

        So it is after most resets: they build the same road anew.
        """
        lanes = network.lanes_list()
        if (
            network is self.network
            or type(network) is not type(self.network)
            or list(network.lanes_dict()) != self.indexes
            or None in self._contents
            or list(map(_content, lanes)) != self._contents
        ):
            return False
        self.network, self.lanes = network, lanes
        return True

    def _read_rules(self) -> list[tuple[Any, ...]]:
        return list(map(_RULES, self.lanes))

    def changed(self, network: Any) -> bool:
        """Must ``network`` be read anew? Lanes added, limits or priorities edited, another one."""
        if network is not self.network:
            return True
        return network.lanes_list() != self.lanes or self._read_rules() != self._rules

    def _topology(self, index: LaneIndex) -> tuple[int, ...]:
        """id, road, count, exits, exits_count of a lane's record."""
        start, end, lane = index
        exits = [self.numbers[end, after, 0] for after in self.network.graph.get(end, ())]
        place = len(self._exits)
        self._exits += exits
        count = len(self.network.graph[start][end])
        return lane, self.numbers[start, end, 0], count, place, len(exits)

    def _record(self, index: LaneIndex, lane: Any) -> list[Any]:
        """The fields of a lane's record, in their order."""
        kind = lane_kind(type(lane))
        if kind is None:
            raise Unknown(f"lane class {type(lane).__name__}")
        length, width, limit, forbidden, priority = _RULES(lane)
        straight, sine, circular, spline = NOT_STRAIGHT, NOT_SINE, NOT_CIRCULAR, NOT_SPLINE
        if kind in (STRAIGHT, SINE):
            places = (*lane.start.tolist(), *lane.direction.tolist())
            straight = (*places, *lane.direction_lateral.tolist(), lane.heading)
        if kind == SINE:
            sine = lane.amplitude, lane.pulsation, lane.phase
        if kind == CIRCULAR:
            circular = (*lane.center.tolist(), lane.radius, lane.start_phase, lane.direction)
        if kind == SPLINE:
            spline = self._spline(lane)
        limited = limit is not None
        rules = length, width, limit if limited else 0.0, priority, kind, bool(forbidden), limited
        return [*straight, *sine, *circular, *rules, *self._topology(index), *spline]

    def _spline(self, lane: Any) -> tuple[int, ...]:
        """poses, poses_count, widths, widths_count of a lane's record."""
        poses, widths = len(self._poses), len(self._widths)
        for at, pose in zip(lane.curve.s_samples, lane.curve.poses, strict=True):
            heading = np.arctan2(pose.normal[1], pose.normal[0])
            self._poses.append((at, *pose.position, *pose.normal, *pose.orthonormal, heading))
        self._widths += getattr(lane, "width_samples", [])
        return poses, len(self._poses) - poses, widths, len(self._widths) - widths

    def links(self, connected: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(starts [L + 1], lanes, offsets): where ``Road.neighbour_vehicles`` looks, per lane."""
        if connected not in self._links and not connected:
            alone = np.arange(len(self.lanes) + 1)
            self._links[False] = alone, alone[:-1], np.zeros(len(self.lanes))
        if connected not in self._links:
            per_lane = [self._links_of(index) for index in self.indexes]
            starts = np.cumsum([0, *map(len, per_lane)])
            flat = [link for links in per_lane for link in links]
            lanes = np.array([lane for lane, _ in flat], np.int64)
            self._links[connected] = starts, lanes, np.array([offset for _, offset in flat], float)
        return self._links[connected]

    def _links_of(self, index: LaneIndex) -> list[tuple[int, float]]:
        links = [(self.numbers[index], 0.0)]
        start, end, lane = index
        graph = self.network.graph
        for following, lanes in graph.get(end, {}).items():
            if lanes:
                number = self.numbers[end, following, lane if lane < len(lanes) else 0]
                links.append((number, self.lanes[self.numbers[index]].length))
        for before, roads in graph.items():
            if roads.get(start):
                number = self.numbers[before, start, lane if lane < len(roads[start]) else 0]
                links.append((number, -self.lanes[number].length))
        return links
