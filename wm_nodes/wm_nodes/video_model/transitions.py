"""The Gaussian of stored transitions under the current weights (DD-1).

Shapes: M transitions, C channels, F latent frames, H W grid, K given frames, U = C (F - K) H W generated elements.
"""

from typing import NamedTuple

from torch import Tensor

from wm_nodes.config.video import RolloutConfig
from wm_nodes.video_model.conditions import Condition
from wm_nodes.video_model.kernels import StepContext, step, with_conditioning
from wm_nodes.video_model.network import VelocityModel, guided_velocity
from wm_nodes.video_model.sampling import normalised_noise
from wm_nodes.video_model.schedule import flow_times


class GaussianTransition(NamedTuple):
    """The Gaussian of M stored transitions."""

    zeta: Tensor
    """(x_s - mean) / std under the weights given, (M, U), with gradient; the others have none."""
    std: Tensor
    """(M, U)."""
    slope: Tensor
    """d mean / d v, (M, U)."""
    sigma_base: Tensor
    """The std where the mask is 1, (M,)."""


def transition(
    model: VelocityModel, condition: Condition, x_t: Tensor, x_s: Tensor, t: Tensor, s: Tensor, mask: Tensor,
    settings: RolloutConfig, *, cfg: float,
) -> GaussianTransition:
    """Return the normalised noise that leads from x_t to x_s under `model`.

    Args:
        x_t, x_s: stored states (M, C, F, H, W). t, s: float64 (M,), s > 0. cfg: guidance of this pass.
        mask: the one used at rollout (M, 1, F, H, W).
    """
    K = condition.num_conditioning
    context = StepContext(condition.frames.float(), float(flow_times(settings.num_steps, settings.shift)[1]), mask)
    x = with_conditioning(x_t.float(), context.conditioning)
    v = guided_velocity(model, x, t, condition, cfg).float()
    law = step(x, v, t, s, context, settings.sampler)
    zeta = normalised_noise(x_s.float(), law, K)
    std, slope = (_elements(value, zeta, K) for value in (law.std, law.slope))
    return GaussianTransition(zeta.flatten(1), std, slope, law.sigma_base)


def _elements(value: Tensor, like: Tensor, num_conditioning: int) -> Tensor:
    generated = value[:, :, num_conditioning:] if value.shape[2] > 1 else value
    return generated.detach().expand_as(like).flatten(1)
