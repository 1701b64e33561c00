"""Files that somebody or something changed: one clear line, nothing written, no code run.

2,000 changed configurations, checkpoints and results in all.
"""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import shutil
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from hypothesis import HealthCheck, example, given, settings, strategies as st

from esc_agents.config import TrainConfig, dump, load_config
from esc_agents.driving.policies import load_policy
from esc_agents.errors import UserError
from esc_agents.paper.results import Damaged as DamagedCell, read_file
from esc_agents.proof.learning import Run
from esc_agents.training import run_directory
from esc_agents.training.callbacks import FixedSeedEvaluation
from esc_agents.training.checkpoint import Damaged, in_order, path_of, read, write
from esc_agents.training.train import newest_state

pytestmark = pytest.mark.slow
REFUSALS = (UserError, Damaged, DamagedCell)
many = settings(
    max_examples=250, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@st.composite
def changed(draw, content: bytes):
    """Bytes that were cut, overwritten, doubled or replaced."""
    place = draw(st.integers(0, len(content)))
    length = draw(st.integers(0, 40))
    middle = draw(st.binary(max_size=40))
    kind = draw(st.sampled_from(["cut", "overwrite", "insert", "repeat", "replace"]))
    if kind == "cut":
        return content[:place]
    if kind == "overwrite":
        return content[:place] + middle + content[place + len(middle) :]
    if kind == "insert":
        return content[:place] + middle + content[place:]
    if kind == "repeat":
        return content[:place] + content[place : place + length] * 2 + content[place + length :]
    return middle


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=10),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=5,
)


def refused_or(load, *args):
    """What ``load`` returns, or None where it says no in its own words."""
    with suppress(*REFUSALS):
        return load(*args)
    return None


@many
@given(data=st.data())
def test_configurations_as_bytes(data, tmp_path):
    path = tmp_path / "config.yaml"
    content = data.draw(changed(dump(TrainConfig()).encode()))
    path.write_bytes(content)
    config = refused_or(load_config, path)
    assert config is None or isinstance(config, TrainConfig)
    assert path.read_bytes() == content


KEYS = [*TrainConfig.model_fields, "schema", "ppo.gamma", "sac.tau", "evaluation.every", "stepz"]


@many
@given(key=st.sampled_from(KEYS), value=values)
def test_configurations_with_any_value(key, value, tmp_path):
    tree = yaml.safe_load(dump(TrainConfig()))
    *parents, last = key.split(".")
    inner = tree
    for parent in parents:
        inner = inner[parent]
    inner[last] = value
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(tree))
    config = refused_or(load_config, path)
    if config:  # what is accepted is within its range, and comes back
        assert 0 <= config.ppo.gamma <= 1
        assert config.n_envs > 0
        assert key != "stepz"
        path.write_text(dump(config))
        assert load_config(path) == config.model_copy(update={"run_dir": None})


@pytest.fixture(scope="module")
def checkpointed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "checkpoints"
    folder.mkdir()
    write(folder, 100, pickle.dumps(list(range(50))))
    return folder.parent


@many
@given(data=st.data())
def test_checkpoints(data, checkpointed):
    whole = in_order(checkpointed / "checkpoints")[0].read_bytes()
    content = data.draw(changed(whole))
    path = path_of(checkpointed / "checkpoints", 200)
    path.write_bytes(content)
    state = refused_or(read, path)
    assert state in (None, pickle.dumps(list(range(50))))
    with suppress(UserError):
        assert newest_state(checkpointed, trust=False) == pickle.dumps(list(range(50)))
    assert path.read_bytes() == content
    path.unlink()


WHOLE = {"size": 0, "sha256": hashlib.sha256(b"").hexdigest()}  # but for its mac


@many
@given(payload=st.binary(max_size=50), header=st.dictionaries(st.text(max_size=8), values))
@example(payload=b"", header={"size": None})
@example(payload=b"", header=WHOLE | {"mac": "é\ud800"})
def test_checkpoints_that_were_made_up(payload, header, checkpointed, tmp_path):
    """Also a pickle that would run code, under whatever header."""

    class Planted:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "ran"),)

    path = path_of(checkpointed / "checkpoints", 300)
    line = json.dumps({"schema": 1, "size": 1, "sha256": "", "mac": "", **header}).encode()
    for state in (payload, pickle.dumps(Planted())):
        path.write_bytes(line + b"\n" + state)
        assert refused_or(read, path) is None
    path.unlink()
    assert not (tmp_path / "ran").exists()


@pytest.fixture
def finished(ppo_run, tmp_path):
    return shutil.copytree(ppo_run, tmp_path / "run")


def spoil(folder: Path, name: str, content: bytes):
    """Put ``content`` in the place of a file, with its checksum, which else would catch it."""
    (folder / name).write_bytes(content)
    run_directory.write_checksums(folder)


@many
@given(data=st.data())
@pytest.mark.parametrize("name", ["policy.json", "policy.safetensors"])
def test_policies(name, data, ppo_run, finished):
    content = data.draw(changed((ppo_run / name).read_bytes()))
    spoil(finished, name, content)
    found = refused_or(load_policy, finished)
    if name == "policy.safetensors":
        assert found is None or content == (ppo_run / name).read_bytes()
    assert (finished / name).read_bytes() == content


@many
@given(data=st.data())
@pytest.mark.parametrize("name", ["results.json", "evaluations.npz", "metrics.csv"])
def test_results(name, data, ppo_run, finished):
    spoil(finished, name, data.draw(changed((ppo_run / name).read_bytes())))
    refused_or(Run.read, finished)
    spoil(finished, name, (ppo_run / name).read_bytes())


@many
@given(content=st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
def test_cells_of_the_papers_table(content, tmp_path):
    path = tmp_path / "b1-5-esc-s0.json"
    path.write_bytes(content)
    assert refused_or(read_file, path) is None


@many
@given(data=st.data())
@pytest.mark.parametrize("name", ["evaluations.npz", "metrics.csv"])
def test_what_a_resumed_run_reads(name, data, ppo_run, tmp_path):
    path = tmp_path / name
    path.write_bytes(data.draw(changed((ppo_run / name).read_bytes())))
    if name == "metrics.csv":
        assert all(
            row[run_directory.STEP].isdigit() for row in run_directory.MetricsFile(path, 99).rows
        )
        return
    evaluation = FixedSeedEvaluation(None, range(1), 10, tmp_path)
    evaluation.model = SimpleNamespace(num_timesteps=20)
    refused_or(evaluation._init_callback)
