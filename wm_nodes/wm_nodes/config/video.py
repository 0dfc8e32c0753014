"""Settings of loop 2, the post-training of the video model. The numbers live in presets/video/*.yaml, not here."""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from wm_nodes.config.judge import JudgeConfig
from wm_nodes.config.schema import AGENT, EXECUTION, DeviceName, TaskName
from wm_nodes.config.sections import (
    Fraction,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    SettingsSection,
)

SAGE_LATEST = 0.997
"""t~ of SAGE's first step (DD-24)."""
Anchor = Literal["buffer", "frozen", "lora_off", "dual"]


class FlowMatchingConfig(SettingsSection):
    num_iterations: PositiveInt
    """Optimizer steps."""
    learning_rate: PositiveFloat
    """Of AdamW, after its warm-up."""
    drop: Fraction
    """Share of videos whose actions and instruction are hidden, for classifier-free guidance."""
    hide_actions: Fraction
    """Share of videos whose actions alone are hidden: the model learns to choose the motion as well."""
    given_frames: NonNegativeInt
    """0: videos are whole episodes of which the first num_conditioning frames are given. Else they are cut out
    anywhere, after 1 to this many given frames, drawn for each batch."""
    new_frames: NonNegativeInt
    """With given_frames: how many frames at most are learned after them; drawn as well."""


class VideoModelConfig(SettingsSection):
    """The embedded video model."""

    stride: PositiveInt
    """Recorded steps between two frames."""
    num_conditioning: NonNegativeInt
    """Leading frames that are given."""
    text_dim: NonNegativeInt
    """Values per hashed word of the instruction."""
    width: PositiveInt
    """Of the network's layers."""
    depth: PositiveInt
    """Residual blocks of the network."""
    batch_size: PositiveInt
    """Clips per training step."""
    training: FlowMatchingConfig
    """By flow matching."""

    @model_validator(mode="after")
    def _cuts_something(self) -> Self:
        if bool(self.training.given_frames) != bool(self.training.new_frames):
            raise ValueError("training.given_frames and new_frames go together; both are 0, or none")
        return self


class ExecutionConfig(SettingsSection):
    """The reward `execution`."""

    model: str
    """Folder of the world model whose action model follows the clips; empty: the shipped one of the task."""


class GroupConfig(SettingsSection):
    contexts: PositiveInt
    """Per iteration."""
    group_size: PositiveInt
    """Videos of each context."""
    shared_noise: bool
    """One initial noise for all videos of a context."""
    hide_actions: bool
    """Videos are made of first frame and instruction alone: the model chooses the motion."""
    history: NonNegativeInt
    """Closed loop: clips at most that the model makes one after the other, each from its own last frames, before those
    of a group, which share them; drawn from 0 on for each iteration. 0: videos are whole recordings."""


class VideoEvaluationConfig(SettingsSection):
    """Held-out contexts, one ODE clip each, before, during and after training."""

    contexts: PositiveInt
    """Of the held-out ones, the first so many."""
    num_steps: PositiveInt
    """Sampler steps."""
    every: NonNegativeInt
    """Buffers between two evaluations of the learner; 0: none."""
    window: Annotated[int, Field(ge=3)]
    """Newest evaluations over which training reward and held-out scores are compared, against reward hacking."""
    executions: NonNegativeInt
    """Held-out clips whose tool path is followed in the simulator before and after training, about 0.1 s each; 0: none.
    """


class WindowConfig(SettingsSection):
    """Which sampler steps are stochastic."""

    strategy: Literal["all", "progressive"]
    """all: every step; progressive: a window of `size` steps that moves on by one every `period` iterations (Mix-GRPO).
    """
    size: PositiveInt
    """Steps in the window."""
    period: PositiveInt
    """Iterations at one place."""


class MaskConfig(SettingsSection):
    """Where the arm dyndiff explores; see video_model/mask.py."""

    m_min: Annotated[float, Field(gt=0, le=1)]
    """Exploration left where nothing moves; a cell without any has no density. 0.05 is very little."""
    quantile: Fraction
    """Cells whose intensity of motion reaches this quantile (q of DD-8) count as dynamic."""
    combine: Literal["gated", "sparse"]
    """How intensity I and sparse prior P become the mask (DD-9). gated: m_min + (1 - m_min) I P, the paper's reading;
    sparse: m_min + (1 - m_min) P."""
    budget: Literal["literal", "rms"]
    """DD-9b. literal: unchanged; rms: its mean square over generated cells becomes 1."""


class SamplerConfig(SettingsSection):
    """What decides the Gaussian of a step; see video_model/kernels.py."""

    arm: Literal["ode", "cps", "dyndiff", "flow", "dance", "sage"]
    """flow: Flow-GRPO; dance: DanceGRPO; sage: SAGE-GRPO."""
    eta: NonNegativeFloat
    """Noise level; in [0, 1] for cps and dyndiff."""
    mask: MaskConfig
    """Of dyndiff only."""

    @field_validator("eta")
    @classmethod
    def _folds(cls, eta: float, info: ValidationInfo) -> float:
        if info.data.get("arm") in ("cps", "dyndiff") and eta > 1:
            raise ValueError(f"eta must be in [0, 1] for {info.data['arm']}, got {eta}: its sine map folds beyond")
        return eta


class RolloutConfig(SettingsSection):
    """How videos are sampled."""

    num_steps: PositiveInt
    """Of the sampler."""
    shift: PositiveFloat
    """Of the flow times towards the noise; 1: none."""
    cfg: float
    """Classifier-free guidance g of v_u + g (v_c - v_u), of rollout and training; 1: off."""
    sampler: SamplerConfig
    """What a step draws from."""
    storage_dtype: Literal["float32", "bfloat16"]
    """Of the kept latents and of each step's noise. A state is rounded to it before its log-probability is taken; noise
    in bfloat16 has a KL of 1e-6 at its own anchor."""
    micro_batch: PositiveInt
    """Videos per network call."""
    buffer_device: Literal["model", "cpu"]
    """Where rollout buffers lie: with the model, or in the host's memory, from where training moves micro-batches."""

    @model_validator(mode="after")
    def _sage_begins_with_noise(self) -> Self:
        """DD-24 has none from t = 1 to t_1 = 1 - left where ln(left / (1 - t~)) <= left."""
        left = 1 / (1 + self.shift * (self.num_steps - 1))
        if self.sampler.arm == "sage" and math.log(left / (1 - SAGE_LATEST)) <= left:
            raise ValueError(
                f"the first step of sampler.arm sage has no noise with num_steps {self.num_steps} and shift "
                f"{self.shift:g}, whose t_1 is {1 - left:.4f}, beyond {SAGE_LATEST}; lower num_steps or shift"
            )
        return self

    @property
    def is_ode(self) -> bool:
        """Whether no step draws noise."""
        return self.sampler.arm == "ode" or self.sampler.eta == 0 or self.num_steps == 1


class AdvantageConfig(SettingsSection):
    clip: PositiveFloat
    """Of the normalised advantage."""
    std_scope: Literal["group", "global"]
    """Which standard deviation normalises, see video_rl/group_advantages.py."""
    best_of_n: NonNegativeInt
    """Videos of a group that train, best and worst; 0: all."""


class KlConfig(SettingsSection):
    mode: Literal["mean", "logk2"]
    """mean: DD-17, of the means of a step; logk2: of log-probabilities (DD-17a)."""
    beta: NonNegativeFloat
    """Weight; 0: no KL."""
    anchor: Anchor
    """buffer: what sampled; frozen: the model as it was at the start; lora_off: the same with the adapter switched off;
    dual: buffer always, and frozen on every `dual_every`-th update."""
    dual_every: PositiveInt
    """Updates from one use of the frozen anchor to the next, with `dual`."""


class NftConfig(SettingsSection):
    """DiffusionNFT: the update from final clips alone, by the forward process; see video_rl/nft.py."""

    beta: PositiveFloat
    """How far the two implied velocities lie from the old one, in differences of the current and the old one."""
    times: PositiveInt
    """Forward times of each clip in one optimizer step."""


class GrpoConfig(SettingsSection):
    """The update of the video model's weights."""

    objective: Literal["ratio", "nft"]
    """ratio: GRPO, by the likelihoods of sampled steps. nft: DiffusionNFT, by noise added to the final clips, from any
    sampler; what is said of ratios, clips and steps below then has no effect."""
    nft: NftConfig
    """Of objective nft."""
    advantage: AdvantageConfig
    """What a reward is worth beside those of its group."""
    kl: KlConfig
    """Distance to an anchor, which is added to the loss."""
    trains: Literal["all", "condition"]
    """Every parameter that asks for a gradient, or those that carry the condition alone."""
    clip: NonNegativeFloat
    """The probability ratio is clipped to [1 - clip, 1 + clip]."""
    logprob_weight: Literal["full", "cps"]
    """Weight of an element in the ratio (DD-14c)."""
    updates_per_buffer: PositiveInt
    """Optimizer steps on one buffer, each on all of it."""
    step_fraction: Fraction
    """Share of the stochastic steps that train, drawn per video."""
    micro_batch: PositiveInt
    """Transitions per network call."""
    learning_rate: NonNegativeFloat
    """Of AdamW."""
    weight_decay: NonNegativeFloat
    """Of AdamW."""
    max_grad_norm: PositiveFloat
    """A longer gradient is scaled to it."""

    @model_validator(mode="after")
    def _nft_has_no_kl(self) -> Self:
        if self.objective == "nft" and self.kl.beta:
            raise ValueError(f"objective nft has no KL, got kl.beta {self.kl.beta}; set kl.beta 0")
        return self


class VideoRlConfig(SettingsSection):
    """Everything of a run of loop 2."""

    seed: NonNegativeInt
    """Of every random number."""
    task: TaskName
    """Whose episodes contexts are taken from."""
    device: DeviceName
    """Of the video model, its codec, the rewards and the learner."""
    iterations: NonNegativeInt
    """Buffers to train on."""
    data_episodes: PositiveInt
    """Simulator episodes to train the video model on and to draw contexts from."""
    context_episodes: PositiveInt
    """Those of a run whose video model is the shipped one."""
    clip_steps: NonNegativeInt
    """Recorded steps of a clip: longer episodes are cut there, shorter ones left out. 0: the episodes have one length;
    others are refused."""
    rewards: dict[str, float]
    """Weight of each reward: a score against the recording (video_rl/reference_reward.py), of which `closeness`,
    `ssim`, `perceptual`, `psnr_db`, `scenery` need no simulator state; `agent`, which needs a judge; or `execution`,
    by an action world model (video_rl/execution_reward.py). Several are added, e.g. {outcome: 0.5, agent: 0.5}."""
    execution: ExecutionConfig
    """Where `execution` is among the rewards."""
    judge: JudgeConfig
    """Where the agent is among the rewards."""
    model: VideoModelConfig
    """What is trained."""
    groups: GroupConfig
    """What is sampled for a buffer."""
    evaluation: VideoEvaluationConfig
    """On held-out contexts."""
    window: WindowConfig
    """Of stochastic sampler steps."""
    rollout: RolloutConfig
    """How it is sampled."""
    grpo: GrpoConfig
    """How it is learned from."""

    @model_validator(mode="after")
    def _samples_different_clips(self) -> Self:
        if self.groups.shared_noise and self.rollout.is_ode and self.grpo.objective == "nft":
            sampler = self.rollout.sampler
            raise ValueError(
                f"groups.shared_noise and a sampler without noise (rollout.sampler.arm {sampler.arm}, eta "
                f"{sampler.eta:g}, rollout.num_steps {self.rollout.num_steps}) make all clips of a group the same; set "
                "groups.shared_noise false"
            )
        return self

    @model_validator(mode="after")
    def _knows_its_conditions(self) -> Self:
        """What a model is asked for is what it was trained on."""
        if self.groups.hide_actions and not self.model.training.hide_actions:
            raise ValueError(
                "groups.hide_actions needs a video model that was trained without actions, too: set "
                "model.training.hide_actions, e.g. 0.5, or take the preset outcome"
            )
        if self.groups.history and not self.model.training.given_frames:
            raise ValueError(
                "groups.history needs a video model that can go on from its own frames: set "
                "model.training.given_frames and new_frames, or take the preset closed_loop"
            )
        if self.groups.history and self.rewards.get(AGENT):
            raise ValueError(
                "a judge sees whole episodes, and groups.history makes parts of them; set rewards.agent 0, or "
                "groups.history 0"
            )
        if self.groups.history and self.rewards.get(EXECUTION):
            raise ValueError(
                "an action world model follows clips from a recorded first frame, and groups.history begins them with "
                "frames that were made; set rewards.execution 0, or groups.history 0"
            )
        return self
