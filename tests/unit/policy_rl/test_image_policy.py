"""The Gaussian in closed form, and the image policy: sizes, determinism, normalisation, clear errors. RS-10d."""

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from wm_nodes.config.load import load_config
from wm_nodes.policy_rl.gaussian import DiagonalGaussian
from wm_nodes.policy_rl.image_policy import ImageEncoder, ImagePolicy

SIDE_PX = 8
IMAGES = np.random.default_rng(0).integers(0, 256, (5, SIDE_PX, SIDE_PX, 3), dtype=np.uint8)
STATES = np.tile(np.array([[0.6, 0.0, 0.15]], np.float32), (5, 1))


def encoder(feature_dim: int = SIDE_PX * SIDE_PX * 3) -> ImageEncoder:
    return ImageEncoder(lambda images: images.float().flatten(1) / 255, feature_dim, "abc")


def make_policy(seed: int = 0) -> ImagePolicy:
    small = load_config("base").policy.model_copy(update={"width": 16, "projection": 8})
    return ImagePolicy(encoder(), 3, 3, small, seed=seed)


def test_positions_reach_the_hidden_layers_unprojected() -> None:
    read = ImageEncoder(encoder().function, SIDE_PX * SIDE_PX * 3, "abc", num_positions=2)
    policy = ImagePolicy(read, 3, 3, load_config("base").policy, seed=0)
    features = torch.rand(2, SIDE_PX * SIDE_PX * 3)
    features[1, :-2] = features[0, :-2]
    assert policy.actor.projection.in_features == features.shape[1] - 2
    assert policy.actor.hidden[0].in_features == policy.actor.projection.out_features + 2 + 3
    means = policy.distribution(features, torch.zeros(2, 3)).mean_BA
    assert (means[0] != means[1]).all()


def test_positions_alone_need_no_projection() -> None:
    read = ImageEncoder(lambda images: images.float().flatten(1)[:, :4], 4, "abc", "positions", 4)
    policy = ImagePolicy(read, 3, 3, load_config("base").policy, seed=0)
    assert policy.actor.hidden[0].in_features == 4 + 3
    assert not any("projection" in name or "norm" in name for name in policy.state_dict())
    assert policy.act(IMAGES, STATES).actions.shape == (5, 3)


def gaussians(*means_and_stds: tuple[float, float], two_valued: bool = False) -> DiagonalGaussian:
    """One sample whose dimensions have these means and standard deviations."""
    means, stds = torch.tensor(means_and_stds).unbind(-1)
    return DiagonalGaussian(means.unsqueeze(0), stds.log(), torch.full(means.shape, two_valued))


def test_the_likelihood_is_the_density_inside_and_the_mass_of_the_tail_at_a_limit() -> None:
    unit, log_sqrt_2pi = gaussians((0.0, 1.0), (0.0, 1.0)), 0.5 * math.log(2 * math.pi)
    beyond_one_std = math.log(0.15865525)
    assert_close(unit.logprob(torch.tensor([[0.5, 0.0]])), torch.tensor([-0.125 - 2 * log_sqrt_2pi]))
    assert_close(unit.logprob(torch.tensor([[1.0, 0.0]])), torch.tensor([beyond_one_std - log_sqrt_2pi]))
    assert_close(unit.logprob(torch.tensor([[-1.0, 1.0]])), torch.tensor([2 * beyond_one_std]))
    assert_close(gaussians((1.0, 0.05)).logprob(torch.tensor([[1.0]])), torch.tensor([math.log(0.5)]))


def test_far_from_the_limits_closed_forms_are_those_of_torch_distributions() -> None:
    generator = torch.Generator().manual_seed(3)
    means, stds = 0.1 * torch.randn(2, 6, 3, generator=generator), 0.02 + 0.05 * torch.rand(2, 3, generator=generator)
    actions = 0.2 * torch.randn(6, 3, generator=generator)
    ours = [DiagonalGaussian(means[i], stds[i].log()) for i in range(2)]
    theirs = [torch.distributions.Normal(means[i], stds[i].expand(6, 3)) for i in range(2)]
    assert_close(ours[0].logprob(actions), theirs[0].log_prob(actions).sum(-1))
    assert_close(ours[0].entropy(), theirs[0].entropy().sum(-1))
    divergence = torch.distributions.kl_divergence(theirs[0], theirs[1]).sum(-1)
    assert_close(ours[0].kl(ours[1]), divergence, rtol=1e-4, atol=0.0)


LIMITED = [((0.0, 0.5), (0.3, 0.4)), ((0.9, 0.4), (1.1, 0.3)), ((-1.3, 0.2), (-0.8, 0.3)), ((0.2, 2.0), (0.0, 1.5))]


@pytest.mark.parametrize("two_valued", [False, True])
@pytest.mark.parametrize(("first", "second"), LIMITED)
def test_entropy_and_kl_at_the_limits_are_the_means_over_executed_actions(
    first: tuple[float, float], second: tuple[float, float], two_valued: bool
) -> None:
    ours, other = (gaussians(one, two_valued=two_valued) for one in (first, second))
    actions = ours.executed(torch.randn(400_000, 1, generator=torch.Generator().manual_seed(0)))
    assert ((actions.abs() == 1).float().mean() > 0.01).item()
    logprobs, others = (g.logprob(actions) for g in (ours, other))
    assert_close(ours.entropy()[0], -logprobs.mean(), atol=0.01, rtol=0)
    assert_close(ours.kl(other)[0], (logprobs - others).mean(), atol=0.01, rtol=0)
    assert_close(ours.kl(ours), torch.zeros(1))


@pytest.mark.parametrize("mean", [0.0, 0.9, 1.2, -0.95, 2.0])
@pytest.mark.parametrize("std", [0.05, 0.4])
@pytest.mark.parametrize("two_valued", [False, True])
def test_the_score_of_executed_actions_has_mean_zero(mean: float, std: float, two_valued: bool) -> None:
    """Else a constant advantage moves the policy: outwards where it fails, without bound."""
    means = torch.full((200_000, 1), mean, dtype=torch.float64, requires_grad=True)
    log_std = torch.tensor([math.log(std)], dtype=torch.float64, requires_grad=True)
    gaussian = DiagonalGaussian(means, log_std, torch.tensor([two_valued]))
    noise = torch.randn(means.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    score, spread = torch.autograd.grad(gaussian.logprob(gaussian.executed(noise).detach()).sum(), [means, log_std])
    assert abs(score.mean()) < 5 * score.std() / len(score) ** 0.5 + 1e-5  # draws too rare to occur
    assert abs(spread / len(score)) < 0.02


def test_likelihood_and_gradient_stay_finite_far_beyond_the_limits() -> None:
    means = torch.tensor([[50.0, -50.0, 0.0]], requires_grad=True)
    gaussian, narrow = (DiagonalGaussian(m, torch.full((3,), -4.0)) for m in (means, torch.zeros(1, 3)))
    total = gaussian.logprob(torch.tensor([[-1.0, 1.0, 1.0]])) + gaussian.kl(narrow) + gaussian.entropy()
    total.sum().backward()
    assert torch.isfinite(total).all() and means.grad is not None and torch.isfinite(means.grad).all()


def test_executed_action_is_the_clamped_sample() -> None:
    gaussian = DiagonalGaussian(torch.tensor([[0.5, -3.0]]), torch.tensor([0.0, 0.0]))
    assert_close(gaussian.executed(torch.tensor([[2.0, 0.0]])), torch.tensor([[1.0, -1.0]]))
    assert_close(gaussian.executed(None), torch.tensor([[0.5, -1.0]]))


def test_a_two_valued_action_is_executed_by_its_sign_and_its_likelihoods_sum_to_one() -> None:
    gaussian = DiagonalGaussian(torch.tensor([[0.3, 0.3]]), torch.tensor([-1.0, -1.0]), torch.tensor([False, True]))
    assert_close(gaussian.executed(None), torch.tensor([[0.3, 1.0]]))
    assert_close(gaussian.executed(torch.tensor([[0.0, -2.0]])), torch.tensor([[0.3, -1.0]]))
    both = torch.tensor([[-1.0], [1.0]])
    assert_close(gaussians((0.3, 0.4), two_valued=True).logprob(both).exp().sum(), torch.tensor(1.0))
    policy = ImagePolicy(encoder(), 3, 3, load_config("base").policy, two_valued=[1])
    for one in (policy, policy.clone()):
        actions = one.act(IMAGES, STATES, noise=np.zeros((5, 3), np.float32)).actions
        assert (np.abs(actions[:, 1]) == 1).all() and (np.abs(actions[:, [0, 2]]) < 1).all()


def test_acting_stores_the_likelihood_of_the_executed_action() -> None:
    policy = make_policy()
    output = policy.act(IMAGES, STATES, noise=np.full((5, 3), 40.0, np.float32))
    assert (output.actions == 1.0).all()
    distribution = policy.distribution(policy.features(IMAGES), torch.from_numpy(STATES))
    assert_close(torch.from_numpy(output.logprobs), distribution.logprob(torch.ones(5, 3)).detach())


def test_generator_and_the_same_noise_give_the_same_action_and_none_is_deterministic() -> None:
    policy = make_policy()
    drawn = policy.act(IMAGES, STATES, torch.Generator().manual_seed(7))
    noise = torch.randn(5, 3, generator=torch.Generator().manual_seed(7)).numpy()
    np.testing.assert_array_equal(drawn.actions, policy.act(IMAGES, STATES, noise=noise).actions)
    first, second = policy.act(IMAGES, STATES), policy.act(IMAGES, STATES)
    np.testing.assert_array_equal(first.actions, second.actions)
    assert np.abs(drawn.actions - first.actions).max() > 0.01


def test_equal_seeds_give_equal_weights_and_leave_the_global_generator_alone() -> None:
    before = torch.get_rng_state()
    first, second, other = make_policy(1), make_policy(1), make_policy(2)
    assert torch.equal(before, torch.get_rng_state())
    for name, tensor in first.state_dict().items():
        assert torch.equal(tensor, second.state_dict()[name])
    assert not torch.equal(first.actor.output.weight, other.actor.output.weight)


def test_default_policy_travels_inline_and_holds_no_encoder() -> None:
    tokens, latent_dim = 16 * 2, load_config("base").tokenizer.latent_dim
    network = torch.nn.Linear(1, 1)
    with_module = ImageEncoder(lambda images: network(torch.zeros(len(images), 1)), tokens * latent_dim)
    policy = ImagePolicy(with_module, 3, 3, load_config("base").policy)
    assert sum(tensor.numel() for tensor in policy.state_dict().values()) * 4 < 1_000_000
    assert not [name for name in policy.state_dict() if "encoder" in name]


def test_actor_and_critic_share_no_parameter() -> None:
    policy = make_policy()
    policy.value(policy.features(IMAGES), torch.from_numpy(STATES)).sum().backward()
    assert all(parameter.grad is None for parameter in [*policy.actor.parameters(), policy.log_std_A])


def test_clone_keeps_its_weights_while_the_original_changes() -> None:
    policy = make_policy()
    copy = policy.clone()
    with torch.no_grad():
        policy.actor.output.bias += 1
    assert_close(copy.actor.output.bias, torch.zeros(3))
    assert not any(parameter.requires_grad for parameter in copy.parameters())
    assert copy.encoder is policy.encoder


def test_features_do_not_depend_on_the_chunk_size() -> None:
    policy = make_policy()
    assert_close(policy.features(IMAGES, batch_size=2), policy.features(IMAGES))
    assert policy.features(IMAGES[:0]).shape == (0, SIDE_PX * SIDE_PX * 3)


def test_static_features_are_not_blown_up_by_the_normaliser() -> None:
    policy = make_policy()
    features = policy.features(IMAGES)
    features[:, 0] = 0.5
    policy.fit_normaliser(features)
    shift, scale = policy.feature_shift_F, policy.feature_scale_F
    assert_close(shift, features.mean(0))
    assert float(scale[0]) == pytest.approx(0.1 * float(features.std(0, correction=0).mean()), rel=1e-5)
    assert_close(scale[1:], features.std(0, correction=0)[1:].clamp(min=float(scale[0])))


def test_wrong_input_is_named() -> None:
    policy = make_policy()
    with pytest.raises(ValueError, match="uint8"):
        policy.features(IMAGES.astype(np.float32))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"states must be \(5, 3\)"):
        policy.act(IMAGES, STATES[:, :2])
    with pytest.raises(ValueError, match="finite, got nan"):
        policy.act(IMAGES, np.full((5, 3), np.nan, np.float32))
    with pytest.raises(ValueError, match="camera differs"):
        encoder(7)(torch.from_numpy(IMAGES))
    with pytest.raises(ValueError, match="at least 2 frames"):
        policy.fit_normaliser(policy.features(IMAGES[:1]))
