"""OpenVLA behind the interface of ImagePolicy (RS-10f): what trains and evaluates that trains and evaluates this.

The likelihood of an action is that of its tokens, renormalised over the 256 action tokens, of which the first two are
executed alike and count as the second; LoRA and value head as in RL4VLA. Shapes: B batch, F = H W 3 features of an
image: its pixels, A action, V action tokens.
"""

import copy
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.special import ndtr

from wm_nodes.config.schema import PolicyConfig, RunConfig
from wm_nodes.core.device import CPU, compute_device
from wm_nodes.core.seeding import initial_weights
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.environments.registry import configured_spec
from wm_nodes.policy_rl.action_tokens import NUM_EDGES, ActionTokenizer
from wm_nodes.policy_rl.image_policy import ImageEncoder, ImagePolicy
from wm_nodes.policy_rl.openvla.model import OpenVla

LORA: dict[str, Any] = {"r": 32, "lora_alpha": 16, "lora_dropout": 0.0, "init_lora_weights": "gaussian"}
LORA["target_modules"] = [
    "qkv", "attn.proj", "fc1", "fc2", "fc3", "q_proj", "k_proj", "v_proj", "o_proj", "gate_proj", "up_proj",
    "down_proj", "lm_head",
]
VALUE_WIDTHS = (512, 128)


class TokenDistribution:
    """The law of the actions of B pictures. entropy and kl are those of each token after the tokens of the actions that
    logprob was last asked about: unbiased where those were drawn from it, and what RL4VLA takes.

    Attributes:
        hidden_BD: what the network had read when it predicted the first of those tokens.
    """

    hidden_BD: Tensor

    def __init__(self, network: OpenVla, tokenizer: ActionTokenizer, images_BHWC: Tensor, action_dim: int) -> None:
        self._network, self._tokenizer, self._images, self._action_dim = network, tokenizer, images_BHWC, action_dim
        self._tokens: Tensor | None = None
        self._logs: Tensor | None = None

    def executed(self, noise_BA: Tensor | None) -> Tensor:
        """The action to execute (B, A), the middles of its tokens' bins: the likeliest token by token, or with standard
        normal noise the token at whose quantile Phi(noise) lies."""

        def choose(logits_BV: Tensor, place: int) -> Tensor:
            logs = log_law(logits_BV.double())
            if noise_BA is None:
                return logs.argmax(-1) + 1
            quantile = ndtr(noise_BA[:, place, None].double())
            below: Tensor = (logs.exp().cumsum(-1) < quantile).sum(-1)
            return below.clamp(max=NUM_EDGES - 2) + 1

        tokens = self._network.generate(self._images, self._action_dim, choose)
        return torch.from_numpy(self._tokenizer.decode(tokens.cpu().numpy())).to(self._images.device)

    def logprob(self, actions_BA: Tensor) -> Tensor:
        """Log likelihood (B,) of executed actions, nats."""
        tokens = self._tokenizer.encode(actions_BA.detach().cpu().numpy().clip(-1, 1))
        self._tokens = torch.from_numpy(tokens).to(self._images.device)
        self._logs = self.log_probabilities(self._tokens)
        picked = self._logs.gather(-1, (self._tokens - self._network.first_id - 1).unsqueeze(-1))
        return picked.squeeze(-1).sum(-1)

    def log_probabilities(self, tokens_BA: Tensor) -> Tensor:
        """(B, A, V - 1) of log_law, of each token after those before it."""
        logits, self.hidden_BD = self._network.action_logits(self._images, tokens_BA)
        return log_law(logits)

    def entropy(self) -> Tensor:
        """(B,), nats, see the class."""
        logs, _ = self._asked()
        return -(logs.exp() * logs).sum((-2, -1))

    def kl(self, other: "TokenDistribution") -> Tensor:
        """KL(self || other) (B,), nats, see the class."""
        logs, tokens = self._asked()
        with torch.no_grad():
            others = other.log_probabilities(tokens)
        return (logs.exp() * (logs - others)).sum((-2, -1))

    def _asked(self) -> tuple[Tensor, Tensor]:
        if self._logs is None or self._tokens is None:
            raise ValueError("entropy and kl of action tokens are about actions; ask for their logprob first")
        return self._logs, self._tokens


def log_law(logits: Tensor) -> Tensor:
    """Log probabilities (..., V - 1) of the action tokens but the first: the second, executed alike, has that of both.
    """
    logs = logits.log_softmax(-1)
    return torch.cat([torch.logaddexp(logs[..., :1], logs[..., 1:2]), logs[..., 2:]], -1)


class OpenVlaPolicy(ImagePolicy):
    """Acts by the leftmost square of a picture and the environment's instruction; the state is not read.

    Only LoRA and value head are trained, saved and sent; the checkpoint stays where it is.

    Args:
        network: of a checkpoint.
        config: kept, not used.
        spec: of the environment.
        seed: of LoRA and value head (stream openvla).
    """

    def __init__(self, network: OpenVla, config: PolicyConfig, spec: EnvironmentSpec, *, seed: int = 0) -> None:
        from peft import LoraConfig, inject_adapter_in_model

        nn.Module.__init__(self)
        height, width = spec.height, spec.width
        self.side, self.config = min(height, width), config

        def pixels(images_BHWC: Tensor) -> Tensor:
            return images_BHWC[:, :, : self.side].flatten(1).float()

        self.encoder = ImageEncoder(pixels, height * self.side * 3)
        self.state_dim, self.action_dim, self._height = spec.state_dim, spec.action_dim, height
        network.requires_grad_(False)
        self._tokenizer = ActionTokenizer(network.vocabulary)
        with initial_weights(seed, "openvla"):
            self.actor = inject_adapter_in_model(LoraConfig(**LORA), network)
            sizes = (network.width, *VALUE_WIDTHS)
            layers = [layer for i, o in pairwise(sizes) for layer in (nn.Linear(i, o), nn.GELU())]
            self.critic = nn.Sequential(*layers, nn.Linear(sizes[-1], 1, bias=False))
        self.log_std_A = nn.Parameter(torch.zeros(spec.action_dim), requires_grad=False)
        self._trained = frozenset(name for name, one in self.named_parameters() if one.requires_grad)

    def clone(self) -> "OpenVlaPolicy":
        """As ImagePolicy.clone; the checkpoint's weights are shared."""
        shared = {id(one): one for name, one in self.named_parameters() if name not in self._trained}
        return copy.deepcopy(self, shared).requires_grad_(False)

    def state_dict(self, *args: Any, **kwargs: Any) -> Any:  # type: ignore[override]
        """LoRA and value head alone."""
        everything = super().state_dict(*args, **kwargs)
        return {name: tensor for name, tensor in everything.items() if name in self._trained}

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """Of state_dict(). Raises KeyError for what is missing or unknown."""
        if strict and state_dict.keys() != self._trained:
            raise KeyError(f"weights of another policy: {sorted(state_dict.keys() ^ self._trained)[:3]}")
        return super().load_state_dict(state_dict, strict=False, assign=assign)

    def fit_normaliser(self, features_BF: Tensor) -> None:
        """The checkpoint has its own."""

    def distribution(self, features_BF: Tensor, states_BS: Tensor) -> TokenDistribution:  # type: ignore[override]
        return TokenDistribution(self._network, self._tokenizer, self._images(features_BF), self.action_dim)

    def value(self, features_BF: Tensor, states_BS: Tensor) -> Tensor:
        """The critic's values (B,), of what the network has read when it predicts the first action token."""
        return self._value_of(self._network.read(self._images(features_BF)).hidden_BD)

    def value_beside(  # type: ignore[override]
        self, distribution: TokenDistribution, features_BF: Tensor, states_BS: Tensor
    ) -> Tensor:
        """As value, of what the distribution has read for its logprob."""
        return self._value_of(distribution.hidden_BD)

    def _value_of(self, hidden_BD: Tensor) -> Tensor:
        values: Tensor = self.critic(hidden_BD.float()).squeeze(-1)
        return values

    def cloning_error(self, features_BF: Tensor, states_BS: Tensor, actions_BA: Tensor) -> Tensor:
        """Mean cross-entropy of the demonstrated action tokens, nats."""
        return -self.distribution(features_BF, states_BS).logprob(actions_BA).mean() / self.action_dim

    @property
    def _network(self) -> OpenVla:
        return cast(OpenVla, self.actor)

    def _images(self, features_BF: Tensor) -> Tensor:
        return features_BF.view(len(features_BF), self._height, self.side, 3)


def make_policy(config: RunConfig) -> OpenVlaPolicy:
    """The policy of policy.checkpoint, in bfloat16 on a GPU. Raises OpenVlaError: the folder holds no checkpoint."""
    device, spec = compute_device(config.device), configured_spec(config)
    dtype = torch.float32 if device.type == CPU else torch.bfloat16
    network = OpenVla.load(Path(config.policy.checkpoint), spec.instruction, dtype)
    return OpenVlaPolicy(network, config.policy, spec, seed=config.seed).to(device)
