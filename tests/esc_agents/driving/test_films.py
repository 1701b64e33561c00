import os
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image, ImageSequence

from esc_agents.driving.films import film, record
from tests.esc_agents.tiny import tiny


def always_idle(observations):
    return np.ones(len(observations["mask"]), np.int64)


@pytest.fixture(scope="module", params=[None, "dummy"])  # "dummy": usual where no screen is
def gif(request, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("SDL_VIDEODRIVER", raising=False)
        if request.param:
            patch.setenv("SDL_VIDEODRIVER", request.param)
        yield from film_and_read(tmp_path_factory)
        assert os.environ.get("SDL_VIDEODRIVER") == request.param


def film_and_read(tmp_path_factory):
    path = film(tiny(), always_idle, 3, tmp_path_factory.mktemp("films"), shuffle=False)
    with Image.open(path) as image:
        frames = ImageSequence.Iterator(image)
        yield path, [(np.asarray(f.convert("RGB")), f.info["duration"]) for f in frames]


def test_one_whole_file(gif):
    path, _ = gif
    assert path.name == "seed-3.gif"
    assert [file.name for file in path.parent.iterdir()] == ["seed-3.gif"]


def test_the_picture_moves(gif):
    frames = [frame for frame, _ in gif[1]]
    assert len(frames) >= 20
    # Traffic moves against the ego in each frame of the drive; the last is held.
    for one, two in pairwise(frames[:20]):
        assert np.abs(one.astype(int) - two).max() > 50
    # Road and cars, not an empty canvas: grey road with at least the green ego on it.
    assert len(np.unique(frames[0].reshape(-1, 3), axis=0)) >= 4


def test_it_plays_in_real_time(gif):
    milliseconds = [duration for _, duration in gif[1]]
    # 6 policy steps a second each, at 5 frames a second, and a short rest on the end.
    assert 6000 <= sum(milliseconds) <= 7500


def test_a_long_episode_is_shown_up_to_a_limit(monkeypatch):
    frames, rate = record(tiny(), always_idle, 3)
    monkeypatch.setattr("esc_agents.driving.films.LONGEST", 2)
    shorter, same = record(tiny(), always_idle, 3)
    assert rate == same
    assert 2 * rate <= len(shorter) <= 3 * rate + 1 < len(frames)  # whole policy steps of a second
    np.testing.assert_array_equal(shorter[1], frames[1])
