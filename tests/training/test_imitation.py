"""A network learns the choices of another policy from pairs of observations and choices."""

import gymnasium as gym
import numpy as np
import pytest

import skillweave as sw
from skillweave._internal.seeding import Seeds
from skillweave.training import imitation


@pytest.mark.parametrize(("side", "drawn"), [(12, 100 * 32), (36, 60 * 16)])
def test_large_images_are_learnt_from_fewer_rows(side, drawn, monkeypatch):
    monkeypatch.setattr(imitation, "GRADIENT_STEPS", 100)
    monkeypatch.setattr(imitation, "BATCH", 32)
    monkeypatch.setattr(imitation, "LARGE_STEPS", 60)
    monkeypatch.setattr(imitation, "LARGE_BATCH", 16)
    rows = []
    likely = imitation.mask_logits

    def counted(logits, mask):
        rows.append(logits.shape[1])
        return likely(logits, mask)

    monkeypatch.setattr(imitation, "mask_logits", counted)
    space = gym.spaces.Box(0, 255, (side, side, 3), np.uint8)
    right = np.arange(200) % 2
    obs = np.zeros((200, side, side, 3), np.uint8)
    obs[right == 1, :, side // 2 :] = 255
    obs[right == 0, :, : side // 2] = 255
    policy = imitation.imitate(
        sw.PPO(network=sw.Network((16,), "relu")), obs, np.ones((200, 2), bool),
        np.eye(2)[right], space, Seeds(0),
    )  # fmt: skip
    assert sum(rows) == drawn
    chosen, _ = policy.act(policy.start(200), obs)
    assert (chosen == right).all()
