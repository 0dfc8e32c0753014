"""PPO in one file, shaped as CleanRL's, in the world model (policy_rl/gym.py); here 3 updates of 64 x 16 steps.

python -m examples.imagined_ppo 3
"""
import sys
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor, nn

GAMMA, LAMBDA, CLIP, EPOCHS, NUM_STEPS, NUM_ENVS, MINIBATCH = 0.97, 0.9, 0.2, 4, 16, 64, 256


class Agent(nn.Module):
    def __init__(self, num_actions: int) -> None:
        super().__init__()
        self.pictures = nn.Sequential(
            nn.Conv2d(3, 16, 8, 4), nn.ReLU(), nn.Conv2d(16, 32, 4, 2), nn.ReLU(), nn.Flatten(), nn.LazyLinear(128))
        self.heads = nn.Sequential(nn.LazyLinear(128), nn.Tanh(), nn.Linear(128, num_actions + 1))
        self.log_std = nn.Parameter(torch.full((num_actions,), -0.5))

    def forward(self, shown: dict[str, Any]) -> tuple[torch.distributions.Normal, Tensor]:
        image, state = torch.as_tensor(shown["image"]).movedim(-1, 1) / 255, torch.as_tensor(shown["state"])
        out = self.heads(torch.cat([self.pictures(image), state], 1))
        return torch.distributions.Normal(out[:, 1:], self.log_std.exp()), out[:, 0]


def main(words: list[str] | None = None) -> None:
    torch.manual_seed(0)
    envs = gymnasium.make_vec("wm_nodes.policy_rl.gym:wm_nodes/Imagined-v0", NUM_ENVS, task="reach")
    agent, (shown, _) = Agent(envs.single_action_space.shape[0]), envs.reset(seed=0)
    agent(shown)  # its lazy layers take their sizes
    optimizer = torch.optim.Adam(agent.parameters(), 1e-3)
    for update in range(1, int((words or sys.argv[1:])[-1]) + 1):
        rows, won = list[tuple[Any, ...]](), list[bool]()
        with torch.no_grad():
            for _ in range(NUM_STEPS):
                policy, values_N = agent(shown)
                actions, before = policy.sample(), shown
                shown, rewards, terminated, truncated, infos = envs.step(actions.clamp(-1, 1).numpy())
                for i in np.flatnonzero(truncated):  # time is up: what would follow is worth what the critic says
                    rewards[i] += GAMMA * agent({name: row[None] for name, row in infos["final_obs"][i].items()})[1][0]
                ended = terminated | truncated
                won += terminated[ended].tolist()
                rows.append((before, actions, policy.log_prob(actions).sum(1), values_N, rewards, ended))
            (gain_N, next_N), gains = (torch.zeros(NUM_ENVS), agent(shown)[1]), list[Tensor]()
            for *_, values_N, rewards, ended in reversed(rows):
                goes_on = torch.as_tensor(~ended)
                delta_N = torch.as_tensor(rewards).float() + GAMMA * next_N * goes_on - values_N
                gain_N, next_N = delta_N + GAMMA * LAMBDA * gain_N * goes_on, values_N
                gains.insert(0, gain_N)
        seen = {name: np.concatenate([row[0][name] for row in rows]) for name in shown}
        acted, logprobs, values = (torch.cat(column) for column in zip(*(row[1:4] for row in rows)))
        gained = torch.cat(gains)
        for chosen in torch.cat([torch.randperm(len(gained)) for _ in range(EPOCHS)]).reshape(-1, MINIBATCH):
            policy, guessed = agent({name: part[chosen.numpy()] for name, part in seen.items()})
            ratio = (policy.log_prob(acted[chosen]).sum(1) - logprobs[chosen]).exp()
            paid = (gained[chosen] - gained[chosen].mean()) / (gained[chosen].std() + 1e-8)
            clipped = torch.minimum(ratio * paid, ratio.clamp(1 - CLIP, 1 + CLIP) * paid).mean()
            optimizer.zero_grad()
            ((guessed - values[chosen] - gained[chosen]).square().mean() / 2 - clipped).backward()
            optimizer.step()
        print(f"update {update}: imagined success {np.mean(won or [False]):.1%}")


if __name__ == "__main__":
    main()
