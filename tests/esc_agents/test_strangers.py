"""Who wrote a file, and which names in it would be imported."""

from __future__ import annotations

import re
from pathlib import Path

import highway_env
import pytest
import yaml

from esc_agents import strangers
from esc_agents.errors import UserError
from esc_agents.reporting import records
from esc_agents.strangers import BLANK, check, foreign, signed

NAMED = {"repr": "evilmod:X"}


@pytest.mark.parametrize(
    "name",
    [
        "esc", "evilmod", "", "esc_gym:ESCEncoder", "esc_gym.encoders:ESCEncoder", "highway-v0",
        "highway_env.vehicle.behavior.IDMVehicle", "esc_gym.evil:X", None, 1.5, True,
    ],
)  # fmt: skip
def test_names_of_ours_or_none(name):
    assert foreign({key: name for key in strangers.KEYS}) == []


@pytest.mark.parametrize(
    "name",
    [
        "evilmod:X", "evilmod.X", ".evilmod:X", "..x:Y", "esc_gym_evil:Y", "highway_envX.y", ":X",
        "highway_env.vehicle..x", "highway_env..vehicle.x", "highway_env.:x", "esc_agents.files:X",
        "evil.highway_env.X", "esc_gym.x/y:Z", "esc_gym:x.y", "esc_gym:a:b", "esc_gym.x:Y\n",
        "esc_gym.x:", "esc_gym. evil:X", "Esc_gym.x:Y", "esc_gym.\u0435ncoders:X", b"evilmod:X",
    ],
)  # fmt: skip
def test_names_of_others(name):
    text = name.decode() if isinstance(name, bytes) else name
    assert foreign({"repr": name}) == [text]
    assert foreign({"train": [{"a": ({b"other_vehicles_type": name},)}]}) == [text]
    assert foreign({"repr": ["esc", {name}]}) == [text]
    assert foreign({"space": {"env_config.other_vehicles_type": {"choices": [name]}}}) == [text]
    assert foreign({"label": name}) == []


def test_a_mapping_in_itself():
    values = yaml.safe_load("&a {env_config: *a, repr: [&b [*b], evilmod:X]}")
    assert foreign(values) == ["evilmod:X"]


def test_highway_env_imports_by_these_keys_only():
    """Lanes have a class_path, too, but no environment makes its road of a configuration."""
    package = Path(str(highway_env.__file__)).parent
    source = "\n".join(path.read_text(encoding="utf-8") for path in package.rglob("*.py"))
    found = set(re.findall(r"(?<!def )class_from_path\((.+?)\)", source))
    key = 'self.config["other_vehicles_type"]'
    assert found == {key, 'cfg["class_path"]', "vehicle_class_path"}
    assert set(re.findall(r"(\S+)\.from_config\(", source)) <= {"super()"}
    assert ".change_vehicles(" not in source
    assert set(re.findall(r"import_module\((.+?)\)", source)) == {"module_name", '"finite_mdp.mdp"'}


@pytest.mark.parametrize("form", ['{{"a": 1, "mac": "{}", "b": 2}}\n', "# mac: {}\na: é\n"])
def test_a_signature_is_of_every_byte(form, tmp_path):
    data = signed(form.format(BLANK)).encode()
    assert BLANK.encode() not in data
    check(tmp_path, data, NAMED, trust=False)
    for place in range(len(data)):
        changed = bytearray(data)
        changed[place] ^= 1
        for other in (bytes(changed), data[:place], data + data[place:]):
            if other != data:
                with pytest.raises(UserError, match="add --trust"):
                    check(tmp_path, other, NAMED, trust=False)


def test_of_another_user(tmp_path, monkeypatch):
    ours = f"mac: {BLANK}"
    theirs = signed(ours)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "other home"))
    for text in (theirs, ours, "", f"mac: {strangers.sign(ours.encode()).hex()}"):
        check(tmp_path, text.encode(), {"repr": "esc"}, trust=False)
        check(tmp_path, text.encode(), NAMED, trust=True)
        with pytest.raises(UserError, match=r"names 'evilmod:X'.*add --trust"):
            check(tmp_path, text.encode(), NAMED, trust=False)


def test_without_a_place_for_a_key(tmp_path, monkeypatch):
    """Nothing can be signed then; what names nothing foreign is written and read as ever."""
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    for repr in ("esc", "evilmod:X"):
        records.write(tmp_path / f"{repr}.json", 1, {"repr": repr})
    assert records.read(tmp_path / "esc.json", 1) == {"repr": "esc"}
    with pytest.raises(UserError, match=r"evilmod:X.json names .*add --trust"):
        records.read(tmp_path / "evilmod:X.json", 1)


def test_a_record_from_before_signatures(tmp_path):
    path = tmp_path / "record.json"
    records.write(path, 1, {"a": 1})
    path.write_text(re.sub(r'"mac": "\w+",', "", path.read_text()))
    assert "mac" not in path.read_text()
    assert records.read(path, 1) == {"a": 1}
