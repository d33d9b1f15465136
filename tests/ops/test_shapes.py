"""Wrong shapes and types of numbers in calls of ops/ are found while the tests run."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

from skillweave.ops import distributions, losses, optim, returns

jaxtyping = pytest.importorskip("jaxtyping")
P, T, B = 2, 3, 4


def of_gae(**changes: torch.Tensor) -> dict[str, torch.Tensor]:
    whole = dict.fromkeys(("reward", "discount", "value", "next_value"), torch.ones(P, T, B))
    last = torch.zeros(P, T, B, dtype=torch.bool)
    return whole | {"last": last, "gae_lambda": torch.ones(P)} | changes


@pytest.mark.parametrize(
    "change",
    [
        {"reward": torch.ones(P, T, B, 1)},
        {"value": torch.ones(P, 1, B)},  # torch itself would broadcast it
        {"gae_lambda": torch.ones(1)},
        {"last": torch.zeros(P, T, B)},
        {"reward": torch.ones(P, T, B, dtype=torch.int64)},
    ],
    ids=str,
)
def test_gae_takes_only_the_shapes_that_it_names(change: dict[str, torch.Tensor]) -> None:
    assert returns.gae(**of_gae()).shape == (P, T, B)
    with pytest.raises(jaxtyping.TypeCheckError, match=next(iter(change))):
        returns.gae(**of_gae(**change))


def test_every_module_of_ops_with_shapes_is_checked() -> None:
    flat = torch.ones(P)
    with pytest.raises(jaxtyping.TypeCheckError):
        losses.approximate_kl(torch.ones(P, B), torch.ones(P, 1))
    with pytest.raises(jaxtyping.TypeCheckError):
        optim.kl_adapted_rate(flat, torch.ones(P, 1), flat, 0.0, 1.0)
    with pytest.raises(jaxtyping.TypeCheckError):
        distributions.categorical_stats(torch.ones(P, B, 3), torch.ones(P, B))


def test_others_use_what_is_checked() -> None:
    from skillweave.algorithms import ppo

    assert ppo.gae is returns.gae
    with pytest.raises(jaxtyping.TypeCheckError):
        ppo.gae(**of_gae(value=torch.ones(P, T, 1)))


@pytest.mark.slow
def test_without_the_tests_nothing_is_checked_and_jaxtyping_is_not_imported() -> None:
    code = (
        "import sys, torch, typing\n"
        "from skillweave.ops import losses\n"
        "losses.approximate_kl(torch.ones(2, 4), torch.ones(2, 1))\n"
        "print(sorted({'jaxtyping', 'beartype'} & set(sys.modules)))\n"
        "print(typing.get_type_hints(losses.td_loss)['value'] is torch.Tensor)\n"
    )
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert result.stdout.split("\n")[:2] == ["[]", "True"]
