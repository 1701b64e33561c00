"""highway-env's vehicles as records and back: what a compiled policy step reads and writes.

``gather`` never changes a vehicle, so that stock code can still run when it finds something
unknown. ``scatter`` writes as ``Vehicle.step`` does: positions in place, everything else anew.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from esc_gym.fastsim.known import BEHAVIOUR, object_kind, vehicle_kind
from esc_gym.fastsim.network import Network, Unknown
from esc_gym.fastsim.records import (
    BICYCLE,
    COMMANDED,
    CONTROLLED,
    CRASH,
    HIT,
    IDM,
    IMPACT,
    LANE_CHANGED,
    LINEAR,
    MOVED,
    NO_LANE,
    NO_ROAD,
    STATE,
    TARGET_CHANGED,
    TRAITS,
    VEHICLE,
    YIELD,
)
from esc_gym.fastsim.traits import (
    DRIVERS,
    NO_ROUTE,
    READ,
    Driver,
    class_traits,
    trait_record,
)

SIZE = VEHICLE.itemsize
NUMBERS = (float, np.float64, int, np.int64)
DOUBLE = np.dtype(float)
NOT_YIELDING = (0, 0)
ROUTE_LENGTH = 16


class Traffic:
    """The vehicles and objects of one road as records [m + 1]; the last one is scratch."""

    def __init__(self) -> None:
        self.items: Any = None  # not [], which is a road without vehicles
        self.n, self._settled = 0, False

    def gather(self, road: Any, network: Network, regulated: bool) -> None:
        """Read everything that a step depends on; Unknown where the kernels cannot go on."""
        self.network = network
        vehicles, objects = road.vehicles, road.objects
        items = vehicles + objects
        if items != self.items or len(vehicles) != self.n:
            self._allocate(items, len(vehicles))
        self.road, self.regulated = road, regulated
        self.yielding_color = getattr(road, "YIELDING_COLOR", None)
        classes = [read(cls) for cls, read in self._classes.items()]
        settled = self._settled and classes == self._class_traits
        self._settled, self._class_traits = False, classes
        for i, item in enumerate(items):
            driver = self._drivers[i]
            if not (settled and driver and driver.untouched(item.__dict__)):
                self._gather_item(i, item)

    def _gather_item(self, i: int, item: Any) -> None:
        if len(item.__dict__) != self._sizes[i]:
            self._sizes[i] = self._checked_size(item)
        kind = self.kinds[i]
        found = READ[kind](item)
        if kind == LINEAR:
            found += (*item.ACCELERATION_PARAMETERS, *item.STEERING_PARAMETERS)
        if found != self._traits[i]:
            TRAITS.pack_into(self.records, i * SIZE + STATE.size, *trait_record(kind, found))
            self._traits[i] = found
        if i >= self.n:
            self._gather_object(i, item)
            return
        self._gather_vehicle(i, kind, item)
        if driver := self._drivers[i]:
            driver.learn(item, kind, self._routes[i] if item.route else NO_ROUTE)

    def _allocate(self, items: list[Any], n: int) -> None:
        kinds: list[Any] = [vehicle_kind(type(vehicle)) for vehicle in items[:n]]
        kinds += [object_kind(type(item)) for item in items[n:]]
        if len(set(map(id, items))) < len(items):
            raise Unknown("one vehicle more than once on the road")
        for item, kind in zip(items, kinds, strict=True):
            if kind is None:
                raise Unknown(f"class {type(item).__name__}")
        m = len(items)
        self.n, self.items, self.kinds = n, items, kinds
        self.records: Any = np.zeros(m + 1, VEHICLE)
        self._traits: list[Any] = [None] * m
        self._sizes = [self._checked_size(item) for item in items]
        self.routes = np.zeros((m, ROUTE_LENGTH, 2), np.int64)
        self._routes: list[Any] = [None] * m
        self._drivers = [Driver() if kind in DRIVERS else None for kind in kinds]
        classes = {type(item): kind for item, kind in zip(items, kinds, strict=True)}
        self._classes = {
            cls: class_traits(cls, kind) for cls, kind in classes.items() if kind in DRIVERS
        }
        self._class_traits: list[Any] = []

    @staticmethod
    def _checked_size(item: Any) -> int:
        """The number of an item's own attributes, none of which replaces a method."""
        if not BEHAVIOUR.isdisjoint(item.__dict__):
            raise Unknown(f"a {type(item).__name__} with methods of its own")
        return len(item.__dict__)

    def _gather_object(self, i: int, item: Any) -> None:
        d = item.__dict__
        x, y = d["position"].tolist()
        lane = self.network.numbers[d["lane_index"]]
        STATE.pack_into(
            self.records, i * SIZE,
            x, y, d["heading"], d["speed"], 0, 0, 0, 0, 0, 0, 0, 0,
            lane, lane, d["crashed"], 0, d["hit"], 0, 0, 0, 0, 0,
        )  # fmt: skip

    def _gather_vehicle(self, i: int, kind: int, vehicle: Any) -> None:
        d = vehicle.__dict__
        position, heading, speed, action = d["position"], d["heading"], d["speed"], d["action"]
        if d["road"] is not self.road:
            raise Unknown("a vehicle of another road")
        if (
            # An unpickled dtype is another object, and its comparison slower.
            (position.dtype is not DOUBLE and position.dtype != DOUBLE)
            or type(speed) not in NUMBERS
            or type(heading) not in NUMBERS
        ):
            raise Unknown("a vehicle state that is not float64")
        x, y = position.tolist()
        lane = self.network.numbers[d["lane_index"]]
        if d["lane"] is not self.network.lanes[lane]:
            raise Unknown("a vehicle whose lane is not that of its lane_index")
        impact = d["impact"]
        push_x, push_y = (0.0, 0.0) if impact is None else impact.tolist()
        target, target_speed, timer, slip, yaw = lane, 0.0, 0.0, 0.0, 0.0
        length = 0
        yielding, yield_timer = NOT_YIELDING
        if kind >= CONTROLLED:
            target = self.network.numbers[d["target_lane_index"]]
            target_speed = d["target_speed"]
            if type(target_speed) not in NUMBERS:
                raise Unknown("a target speed that is not float64")
            if route := d["route"]:
                length = self._gather_route(i, route)
            if kind >= IDM:
                timer = d["timer"]
            if "is_yielding" in d:
                yielding, yield_timer = d["is_yielding"], d["yield_timer"]
        elif kind == BICYCLE:
            slip, yaw = d["lateral_speed"], d["yaw_rate"]
        STATE.pack_into(
            self.records, i * SIZE,
            x, y, heading, speed, action["steering"], action["acceleration"], timer,
            target_speed, push_x, push_y, slip, yaw,
            lane, target, d["crashed"], impact is not None, d["hit"], yielding, yield_timer,
            length, 0, 0,
        )  # fmt: skip

    def _gather_route(self, i: int, route: list[Any]) -> int:
        """Write a route into ``routes`` if it is not the one there; its length."""
        if route != self._routes[i]:
            steps = [self._route_step(*step) for step in route]
            if len(steps) > self.routes.shape[1]:
                wider = np.zeros((len(self.items), 2 * len(steps), 2), np.int64)
                wider[:, : self.routes.shape[1]] = self.routes
                self.routes = wider
            self.routes[i, : len(steps)] = steps
            self._routes[i] = list(route)
        return len(route)

    def _route_step(self, start: str, end: str, lane: int | None) -> tuple[int, int]:
        road = self.network.numbers.get((start, end, 0), NO_ROAD)
        if self.regulated:
            # The road rules look ahead along routes, lanes that are left open taken as the present.
            count = self.network.most_lanes if lane is None else lane + 1
            if not 0 < count <= (self.network.records["count"][road] if road != NO_ROAD else 0):
                raise Unknown("road rules on a route whose lanes differ in number")
        return road, NO_LANE if lane is None else lane

    def _sync_route(self, i: int, taken: int) -> None:
        """Drop the steps that were taken from the vehicle's own route, in place as stock does."""
        if taken:
            del self.items[i].route[:taken]
            self._routes[i] = None

    def controlled(self, vehicle: Any) -> int:
        """The number of the vehicle that takes an action."""
        for i in range(self.n):
            if self.items[i] is vehicle:
                return i
        raise Unknown("the controlled vehicle is not on the road")

    def follow_road(self, i: int) -> None:
        """Let vehicle i, in mid-step, change to the lane after its own, by stock code."""
        vehicle, record = self.items[i], self.records[i]
        vehicle.position[:] = record["x"], record["y"]
        if record["changed"] & TARGET_CHANGED:
            vehicle.target_lane_index = self.network.indexes[record["target_lane"]]
            record["changed"] ^= TARGET_CHANGED
        self._sync_route(i, record["route_taken"])
        vehicle.follow_road()
        record["target_lane"] = self.network.numbers[vehicle.target_lane_index]
        record["route_length"] = self._gather_route(i, vehicle.route) if vehicle.route else 0
        record["route_taken"] = 0

    def scatter(self, samples: np.ndarray) -> None:
        """Write a simulated step back to the vehicles; samples [S, 8]: LinearVehicle's data."""
        places = self.records.tobytes()
        for i, item in enumerate(self.items):
            driver = self._drivers[i]
            x, y, heading, speed, steering, acceleration, timer, taken, changed = MOVED.unpack_from(
                self.records, i * SIZE
            )
            if i < self.n:
                d, kind = item.__dict__, self.kinds[i]
                if kind == BICYCLE:
                    slip, yaw = STATE.unpack_from(self.records, i * SIZE)[10:12]
                    d["position"] = np.array((x, y))
                    d["lateral_speed"], d["yaw_rate"] = np.float64(slip), np.float64(yaw)
                else:
                    position = d["position"]
                    position[0] = x
                    position[1] = y
                d["heading"] = np.float64(heading)
                d["speed"] = np.float64(speed) if type(d["speed"]) is np.float64 else speed
                if kind >= CONTROLLED:
                    d["action"] = {"steering": steering, "acceleration": acceleration}
                else:
                    d["action"]["steering"], d["action"]["acceleration"] = steering, acceleration
                if kind >= IDM:
                    d["timer"] = timer
                if driver:
                    driver.heading, driver.speed = d["heading"], d["speed"]
                    driver.timer = d.get("timer")
                    driver.place = places[i * SIZE : i * SIZE + 16]
            if changed:
                self._scatter_changes(item, STATE.unpack_from(self.records, i * SIZE), changed)
            self._sync_route(i, taken)
            if driver and (changed or taken):
                driver.size = -1
        for row in samples:
            _append_sample(self.items[int(row[0])].data, row)
        self._settled = True

    def _scatter_changes(self, item: Any, state: tuple[Any, ...], changed: int) -> None:
        network, d = self.network, item.__dict__
        lane, target, crashed, has_impact, hit, yielding, yield_timer = state[12:19]
        if changed & LANE_CHANGED:
            d["lane_index"], d["lane"] = network.indexes[lane], network.lanes[lane]
        if changed & TARGET_CHANGED:
            start, end, number = network.indexes[target]
            # As ControlledVehicle.act leaves it, which clips the number with NumPy.
            number = np.int64(number) if changed & COMMANDED else number
            d["target_lane_index"] = start, end, number
        if changed & CRASH:
            d["crashed"] = bool(crashed)
        if changed & IMPACT:
            d["impact"] = np.array(state[8:10]) if has_impact else None
        if changed & HIT:
            d["hit"] = bool(hit)
        if changed & YIELD:
            d["target_speed"] = 0 if yielding else state[7]
            d["is_yielding"], d["yield_timer"] = bool(yielding), yield_timer
            if yielding:
                d["color"] = self.yielding_color
            else:
                d.pop("color", None)


def _append_sample(data: dict[str, Any], row: np.ndarray) -> None:
    """What ``LinearVehicle.add_features`` does."""
    parts = ("longitudinal", row[1:4], row[4]), ("lateral", row[5:7], row[7])
    for name, features, output in parts:
        lists = data.setdefault(name, {"features": [], "outputs": []})
        lists["features"].append(features.copy())
        lists["outputs"].append(output)
