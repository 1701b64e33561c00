"""The data: uniform, independent, the same wherever and in whatever order it is drawn."""

from __future__ import annotations

import subprocess
import sys
from fractions import Fraction

import numpy as np
import pytest
import torch
from scipy import stats

from esc_agents.paper import samples
from esc_agents.paper.samples import COUNTS, Samples

TEST = Samples("test", 0, 20)


def test_the_generator_is_splitmix64():
    """The first outputs from state 1234567, as published with many implementations."""
    published = [
        6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431,
        16408922859458223821,
    ]  # fmt: skip
    found = samples._scramble(torch.arange(1, 6), 1234567)
    assert found.tolist() == [number >> 32 for number in published]


def test_a_sample_follows_from_whole_numbers_alone():
    """Re-derived with Python's integers and fractions, rounded as IEEE 754 does."""
    mask = (1 << 64) - 1

    def mix(z: int) -> int:
        z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9 & mask
        z = (z ^ z >> 27) * 0x94D049BB133111EB & mask
        return z ^ z >> 31

    key = 0
    for byte in b"11\0train\0":
        key = mix((key ^ byte) * 0x9E3779B97F4A7C15 & mask)
    for number in (0, 17, 999_999):
        counters = range(number * 111, (number + 1) * 111)  # 20 x 5 + 10 numbers, and the size
        bits = [mix((counter * 0x9E3779B97F4A7C15 + key) & mask) >> 32 for counter in counters]
        values = [
            np.float32(-5 + Fraction(float(np.float32(Fraction(10 * (word >> 8), 1 << 24)))))
            for word in bits[:110]
        ]
        size = 1 + (20 * bits[110] >> 32)
        drawn = Samples("train", 11, None).draw(torch.tensor([number]))
        assert drawn.vehicles[0, :size].flatten().tolist() == values[: size * 5]
        assert drawn.ego[0].tolist() == values[100:]
        assert drawn.mask[0].tolist() == [True] * size + [False] * (20 - size)


def test_values_are_uniform():
    drawn = TEST.all()
    assert drawn.vehicles.shape == (2048, 20, 5)
    assert drawn.ego.shape == (2048, 10)
    values = torch.cat([drawn.vehicles.flatten(1), drawn.ego], dim=1).double().numpy()
    assert values.min() >= -5
    assert values.max() < 5
    assert stats.kstest(values.ravel(), stats.uniform(-5, 10).cdf).pvalue > 0.001
    # 110 places in 2048 samples: no two of them move together.
    correlation = np.corrcoef(values.T) - np.eye(values.shape[1])
    assert np.abs(correlation).max() < 6 / np.sqrt(len(values))
    assert len(np.unique(values)) > 0.98 * values.size  # 2^24 values can occur


def test_variable_sizes():
    sets = Samples("test", 3, None).all()
    sizes = sets.mask.sum(dim=1)
    assert stats.chisquare(np.bincount(sizes, minlength=21)[1:]).pvalue > 0.001
    assert torch.equal(sets.mask, torch.arange(20) < sizes[:, None])
    assert (sets.vehicles[~sets.mask] == 0).all()


def test_sets_of_different_sizes_are_nested():
    one, other = Samples("test", 1, 5).all(), Samples("test", 1, 15).all()
    assert torch.equal(one.vehicles, other.vehicles[:, :5])
    assert torch.equal(one.ego, other.ego)


def test_seeds_and_splits_differ():
    index = torch.arange(100)
    drawn = [
        Samples(split, seed, 5).draw(index).ego for split in ("train", "test") for seed in (0, 1)
    ]
    for number, ego in enumerate(drawn):
        assert not any((ego == other).any() for other in drawn[:number])


def test_a_sample_is_the_same_wherever_it_is_drawn():
    index = torch.tensor([999_999, 3, 3, 512])
    drawn = Samples("train", 7, None).draw(index)
    for row, number in enumerate(index):
        alone = Samples("train", 7, None).draw(number[None])
        for together, single in zip(drawn, alone, strict=True):
            assert torch.equal(together[row], single[0])


def test_batches_cover_the_split():
    train = Samples("train", 0, 5)
    batch = torch.cat([train.batch(update, 512) for update in range(200)])
    assert batch.min() >= 0
    assert batch.max() < COUNTS["train"]
    assert stats.kstest(batch.numpy() / COUNTS["train"], "uniform").pvalue > 0.001
    assert torch.equal(train.batch(7, 512), train.batch(7, 512))
    assert not torch.equal(train.batch(7, 512), Samples("train", 1, 5).batch(7, 512))


def test_the_same_in_another_process():
    code = (
        "import torch; from esc_agents.paper.samples import Samples;"
        "print(Samples('test', 5, 10).all().vehicles.double().sum().item())"
    )
    printed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert float(printed) == Samples("test", 5, 10).all().vehicles.double().sum().item()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a second device")
def test_the_same_on_a_gpu():
    here, there = TEST.all(), TEST.all("cuda")
    for a, b in zip(here, there, strict=True):
        assert torch.equal(a, b.cpu())


def test_several_seeds_at_once():
    index = torch.stack([torch.arange(6), torch.arange(6) * 100])
    for size in (4, None):
        both = Samples("train", (3, 8), size)
        alone = [Samples("train", seed, size) for seed in (3, 8)]
        assert torch.equal(both.batch(2, 9), torch.stack([one.batch(2, 9) for one in alone]))
        drawn = both.draw(index)
        for number, one in enumerate(alone):
            expected = one.draw(index[number])
            assert torch.equal(drawn.vehicles[number], expected.vehicles)
            assert torch.equal(drawn.ego[number], expected.ego)
